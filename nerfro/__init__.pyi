# Public names of nerfro, which `lazy_loader` imports on first access.
from .backgrounds.base import ConstantBackground
from .backgrounds.envmap import EnvironmentMap
from .capture.preprocess import preprocess
from .core.cameras import Cameras
from .core.rays import Rays
from .data.capture import Capture
from .data.formats.transforms import BlenderData
from .evaluation.collection import metrics
from .fields.hash_grid import HashGridField
from .geometry.space import Box, Contracted
from .losses.terms import Photometric
from .masks.segment import segment
from .media.bodies import Bodies, Body, GridSettings
from .media.body_settings import make_bodies
from .media.material import Material
from .media.surfaces import BallSurface, MeshSurface
from .models.refractive import RefractiveModel
from .optimizers.config import GroupConfig, OptimizerConfig
from .pipeline.evaluate import evaluate
from .pipeline.export import export
from .pipeline.reconstruct import reconstruct
from .pipeline.render import render
from .poses.calibrate import calibrate
from .rendering.renderer import Components
from .rendering.scene_file import SceneFile
from .samplers.base import Straight
from .samplers.paths.bend import bend, polylines
from .samplers.paths.snell import Snell
from .samplers.points.stratified import Stratified
from .training.build import build
from .training.data_module import RayDataModule
from .training.module import TrainingModule
from .training.pixel_batches import PixelBatches
from .training.run import Run, train
from .training.run_folder import load
from .viewing.trained_scene import TrainedScene

__version__: str
__all__ = [
    "BallSurface",
    "BlenderData",
    "Bodies",
    "Body",
    "Box",
    "Cameras",
    "Capture",
    "Components",
    "ConstantBackground",
    "Contracted",
    "EnvironmentMap",
    "GridSettings",
    "GroupConfig",
    "HashGridField",
    "Material",
    "MeshSurface",
    "OptimizerConfig",
    "Photometric",
    "PixelBatches",
    "RayDataModule",
    "Rays",
    "RefractiveModel",
    "Run",
    "SceneFile",
    "Snell",
    "Straight",
    "Stratified",
    "TrainedScene",
    "TrainingModule",
    "__version__",
    "bend",
    "build",
    "calibrate",
    "evaluate",
    "export",
    "load",
    "make_bodies",
    "metrics",
    "polylines",
    "preprocess",
    "reconstruct",
    "render",
    "segment",
    "train",
]
