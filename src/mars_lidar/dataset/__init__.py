"""Datasets: from scenes to a training set on disk, and back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mars_lidar.dataset.run import Generated, generate

if TYPE_CHECKING:
    from mars_lidar.dataset.estimate import Estimate, estimate
    from mars_lidar.dataset.estimate import quick_advice as quick_advice
    from mars_lidar.dataset.light import Light
    from mars_lidar.dataset.network_files import Exported, export
    from mars_lidar.dataset.read import read_sparse
    from mars_lidar.dataset.recipe import DatasetRecipe
    from mars_lidar.dataset.schema import json_schema
    from mars_lidar.dataset.store import Dataset, open_dataset
    from mars_lidar.dataset.verify import Verified, verify
    from mars_lidar.dataset.view import View, read_view

_MODULES = {
    "Dataset": "store",
    "DatasetRecipe": "recipe",
    "Estimate": "estimate",
    "Exported": "network_files",
    "Light": "light",
    "Verified": "verify",
    "View": "view",
    "estimate": "estimate",
    "export": "network_files",
    "json_schema": "schema",
    "open_dataset": "store",
    "quick_advice": "estimate",
    "read_sparse": "read",
    "read_view": "view",
    "verify": "verify",
}


def __getattr__(name: str) -> Any:  # `import mars_lidar` loads no Zarr
    if name in _MODULES:
        from importlib import import_module

        module = import_module(f"mars_lidar.dataset.{_MODULES[name]}")
        for each, home in _MODULES.items():  # all of them: `verify` is the function, not the module of the same name
            if home == _MODULES[name]:
                globals()[each] = getattr(module, each)
        return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
    "Dataset",
    "DatasetRecipe",
    "Estimate",
    "Exported",
    "Generated",
    "Light",
    "Verified",
    "View",
    "estimate",
    "export",
    "generate",
    "json_schema",
    "open_dataset",
    "read_sparse",
    "read_view",
    "verify",
]
