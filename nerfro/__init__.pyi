# Public names of nerfro, which `lazy_loader` imports on first access.
from .backgrounds.constant import ConstantBackground
from .backgrounds.envmap import EnvironmentMap
from .core.cameras import Cameras
from .core.rays import Rays
from .data.blender import BlenderData
from .evaluation.collection import metrics
from .fields.hash_grid import HashGridField
from .losses.photometric import Photometric
from .media.sdf_grid import SdfGrid
from .media.shapes import Ball
from .models.refractive import RefractiveModel
from .rendering.renderer import Components
from .samplers.paths.bend import bend, polylines
from .samplers.paths.snell import Snell
from .samplers.paths.straight import Straight
from .samplers.points.stratified import Stratified
from .training.build import build
from .training.data_module import RayDataModule
from .training.load import load
from .training.module import TrainingModule
from .training.optimizer import GroupConfig, OptimizerConfig
from .training.pixel_batches import PixelBatches
from .viewing.trained_scene import TrainedScene

__version__: str
__all__ = [
    "Ball",
    "BlenderData",
    "Cameras",
    "Components",
    "ConstantBackground",
    "EnvironmentMap",
    "GroupConfig",
    "HashGridField",
    "OptimizerConfig",
    "Photometric",
    "PixelBatches",
    "RayDataModule",
    "Rays",
    "RefractiveModel",
    "SdfGrid",
    "Snell",
    "Straight",
    "Stratified",
    "TrainedScene",
    "TrainingModule",
    "__version__",
    "bend",
    "build",
    "load",
    "metrics",
    "polylines",
]
