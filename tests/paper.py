"""A small model of the paper's components."""

from nerfro.paper.eikonal import Eikonal
from nerfro.paper.hierarchical import Hierarchical
from nerfro.paper.nerf import NerfField, Skybox
from nerfro.rendering import Components
from tests.closed_forms import Luneburg


def small_components() -> Components:
    """Small components of the paper's model, around a Luneburg lens."""
    return Components(
        medium=Luneburg(),
        path_sampler=Eikonal("euler", 64),
        point_sampler=Hierarchical(8, 8),
        make_field=lambda: NerfField(width=16, depth=2, skip=1, view_width=8),
        background=Skybox(width=8),
    )
