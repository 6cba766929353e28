"""Datasets: from scenes to a training set on disk, and back."""

from mars_lidar.dataset.estimate import Estimate, estimate
from mars_lidar.dataset.estimate import quick_advice as quick_advice
from mars_lidar.dataset.network_files import Exported, export
from mars_lidar.dataset.recipe import DatasetRecipe, Light, json_schema
from mars_lidar.dataset.run import Generated, begin, finish, generate, make_part
from mars_lidar.dataset.sources import View, read_view
from mars_lidar.dataset.store import Dataset, open_dataset, read_sparse
from mars_lidar.dataset.verify import Verified, verify

__all__ = [
    "Dataset",
    "DatasetRecipe",
    "Estimate",
    "Exported",
    "Generated",
    "Light",
    "Verified",
    "View",
    "begin",
    "estimate",
    "export",
    "finish",
    "generate",
    "json_schema",
    "make_part",
    "open_dataset",
    "read_sparse",
    "read_view",
    "verify",
]
