"""Every registered plugin, including local plugins, keeps the contract of its type."""

import pytest

from nerfro.registry.registration import KINDS, Plugin, discover, plugins
from nerfro.testing import check
from nerfro.testing.contracts import _CONTRACTS

discover()

# What has no default that builds, or is needlessly large with its defaults.
FIELDS: dict[str, dict[str, object]] = {
    "medium/sdf_grid": {"mesh": "embedded:torus/mesh.ply", "resolution": 32},
    "medium/voxel_grid": {"mesh": "embedded:torus/mesh.ply", "resolution": 32, "smoothing_size": 3},
    "surface/ball": {"radius": 1.0},
    "surface/box": {"sides": [1.0, 1.0, 0.2], "rounding": 0.05},
    "surface/mesh": {"file": "embedded:torus/mesh.ply"},
    "surface/offset": {"surface": {"name": "ball", "radius": 1.0}, "distance": 0.2},
    "surface/revolution": {"profile": [[1.0, 0.0], [0.5, 1.0]], "axis": [1.0, 1.0, 0.0]},
    "sampler/path/eikonal": {"num_steps": 128},
    "field/nerf": {"width": 16, "depth": 3, "skip": 2, "view_width": 8},
    "field/mip_nerf": {"width": 16, "depth": 3, "skip": 2, "view_width": 8},
    "loss/smoothness": {"tile_size": 8},
}


def test_types_of_plugins_have_one_abstract_method() -> None:
    abstract = {kind: len(getattr(base, "__abstractmethods__", ())) for kind, (base, _) in _CONTRACTS.items()}
    assert abstract == dict.fromkeys(KINDS, 1) | {"phase": 2, "data": 2, "callbacks": 0}


@pytest.mark.parametrize("plugin", plugins(), ids=lambda p: f"{p.kind}/{p.name}")
def test_plugin_keeps_its_contract(plugin: Plugin) -> None:
    fields = FIELDS.get(f"{plugin.kind}/{plugin.name}", {})
    required = {name for name, _, default in plugin.fields() if default == "required"} - fields.keys()
    if required:
        pytest.skip(f"needs {', '.join(required)}, which only its own tests can give")
    check(plugin, fields)
