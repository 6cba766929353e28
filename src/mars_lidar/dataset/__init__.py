"""Datasets: from scenes to a training set on disk, and back."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mars_lidar._base.imports import names_of

if TYPE_CHECKING:
    from mars_lidar.dataset.estimate import Estimate as Estimate
    from mars_lidar.dataset.estimate import estimate as estimate
    from mars_lidar.dataset.estimate import quick_advice as quick_advice
    from mars_lidar.dataset.network_files import Exported as Exported
    from mars_lidar.dataset.network_files import export as export
    from mars_lidar.dataset.recipe import DatasetRecipe as DatasetRecipe
    from mars_lidar.dataset.recipe import Light as Light
    from mars_lidar.dataset.recipe import json_schema as json_schema
    from mars_lidar.dataset.run import Generated as Generated
    from mars_lidar.dataset.run import begin as begin
    from mars_lidar.dataset.run import finish as finish
    from mars_lidar.dataset.run import generate as generate
    from mars_lidar.dataset.run import make_part as make_part
    from mars_lidar.dataset.sources import View as View
    from mars_lidar.dataset.sources import read_view as read_view
    from mars_lidar.dataset.store import Dataset as Dataset
    from mars_lidar.dataset.store import open_dataset as open_dataset
    from mars_lidar.dataset.store import read_sparse as read_sparse
    from mars_lidar.dataset.verify import Verified as Verified
    from mars_lidar.dataset.verify import verify as verify

_HOMES = {
    **dict.fromkeys(("Dataset", "open_dataset", "read_sparse"), "store"),
    **dict.fromkeys(("DatasetRecipe", "Light", "json_schema"), "recipe"),
    **dict.fromkeys(("Estimate", "estimate", "quick_advice"), "estimate"),
    **dict.fromkeys(("Exported", "export"), "network_files"),
    **dict.fromkeys(("Generated", "begin", "finish", "generate", "make_part"), "run"),
    **dict.fromkeys(("Verified", "verify"), "verify"),
    **dict.fromkeys(("View", "read_view"), "sources"),
}
__getattr__ = names_of(__name__, _HOMES)  # `import mars_lidar` loads no Zarr
__all__ = [name for name in _HOMES if name != "quick_advice"]
