"""Everything that a plugin needs: base classes, the values that pass between components, `register`, and ranges.

A plugin begins with one import, such as `from nerfro.parts import Loss, register`; see docs/guides/plugins.md.
"""

from annotated_types import Ge, Gt, Le, Lt

from nerfro.backgrounds.base import Background
from nerfro.camera.base import CameraModel
from nerfro.core.cameras import Cameras
from nerfro.core.draws import Draws
from nerfro.core.errors import NerfroError
from nerfro.core.paths import resolve_path
from nerfro.core.types import Batch, Exits, FieldValues, OpticalRecord, Path, Rays, Rendering, Samples
from nerfro.data.base import DataSource, Views
from nerfro.evaluation.image_metrics import ErrorMap, ImageMetric, ViewMaps
from nerfro.fields.base import Field
from nerfro.files.atomic import write_atomically
from nerfro.files.reading import load_arrays
from nerfro.geometry.mesh import TriangleMesh
from nerfro.geometry.space import Box, Contracted, Space, Unbounded
from nerfro.losses.base import Loss
from nerfro.media.base import Medium, Scalars, Vectors
from nerfro.media.bodies import Bodies, Body, GridSettings
from nerfro.media.material import MATERIALS, Material, Sellmeier
from nerfro.media.surfaces import Grid, MeshSurface, Surface
from nerfro.models.refractive import RefractiveModel
from nerfro.optimizers.config import OPTIMIZERS, SCHEDULERS
from nerfro.registry.allowed import Count, Distance, Natural, NotNegative, OnlyWith, Positive
from nerfro.registry.registration import register
from nerfro.rendering import Components, Renderer, Scene
from nerfro.samplers.base import PathSampler, PointSampler
from nerfro.samplers.points.stratified import Stratified, invert_cdf, point_samples, spread_uniform
from nerfro.training.phases.base import Phase, TrainingRun
from nerfro.viewing.exports import EXPORTS, Export, ExportConfig
from nerfro.viewing.trained_scene import TrainedScene

__all__ = [
    "EXPORTS", "MATERIALS", "OPTIMIZERS", "SCHEDULERS", "Background", "Batch", "Bodies", "Body", "Box", "CameraModel",
    "Cameras", "Components", "Contracted", "Count", "DataSource", "Distance", "Draws", "ErrorMap", "Exits", "Export",
    "ExportConfig", "Field", "FieldValues", "Ge", "Grid", "GridSettings", "Gt", "ImageMetric", "Le", "Loss", "Lt",
    "Material", "Medium", "MeshSurface", "Natural", "NerfroError", "NotNegative", "OnlyWith", "OpticalRecord", "Path",
    "PathSampler", "Phase", "PointSampler", "Positive", "Rays", "RefractiveModel", "Renderer", "Rendering",
    "Samples", "Scalars", "Scene", "Sellmeier", "Space", "Stratified", "Surface", "TrainedScene", "TrainingRun",
    "TriangleMesh", "Unbounded", "Vectors", "ViewMaps", "Views", "invert_cdf", "load_arrays", "point_samples",
    "register", "resolve_path", "spread_uniform", "write_atomically",
]  # fmt: skip
