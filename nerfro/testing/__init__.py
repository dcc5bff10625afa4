"""Contracts of plugins. The test suite checks all registered plugins, including yours.

`check(plugin)` builds the plugin with its defaults, calls the plugin as the model does, and raises `ContractError` for
a broken contract. For plugins with required fields, give the values of these fields. `check_export` tests an export,
and `check_optics` compares a path sampler with closed forms. `nerfro check` calls them from the command line.
"""

from nerfro.testing.contracts import ContractError, check, check_export
from nerfro.testing.examples import (
    NUM_RAYS,
    LuneburgLens,
    example_ball,
    example_batch,
    example_components,
    example_draws,
    example_path,
    example_rays,
    example_rendering,
    example_run,
    example_samples,
    example_space,
    example_views,
)
from nerfro.testing.optics import OpticalError, check_optics

__all__ = [
    "NUM_RAYS", "ContractError", "LuneburgLens", "OpticalError", "check", "check_export", "check_optics",
    "example_ball", "example_batch", "example_components", "example_draws", "example_path", "example_rays",
    "example_rendering", "example_run", "example_samples", "example_space", "example_views",
]  # fmt: skip
