"""`compile=`: fields and backgrounds in the form of GPUs, compiled by torch.compile."""

import pytest
import torch

from nerfro.backgrounds import cube_map
from nerfro.core.errors import NerfroError
from nerfro.core.paths import PACKAGE_DIR
from nerfro.core.types import Path
from nerfro.fields import hash_encoding, hash_grid, relu_mlp
from nerfro.kernels.available import require_backend
from nerfro.kernels.operators import REFERENCES
from nerfro.registry.registration import build
from nerfro.rendering import Renderer
from nerfro.training.config import build_medium, build_model
from nerfro.training.derivation import derived
from tests.conftest import composed
from tests.processes import printed_by
from tests.test_experiments import SMALL, shrunk

# One graph for the field and one for the background. The number of samples in the object's box divides the former.
NUM_GRAPHS = {"straight": 2, "refractive": 4}
OPERATORS = (
    (hash_encoding, "hash_encode"), (hash_grid, "spherical_harmonics"), (relu_mlp, "relu_mlp"), (cube_map, "lookup"),
)  # fmt: skip


def test_compiled_scenes_have_few_graphs_and_the_same_radiance_and_gradients() -> None:
    # A process of its own, because pytest runs functions with checks of their arrays, which divide the graphs.
    command = f"from {__name__} import compare; compare()"
    printed_by("-W", "error::UserWarning", "-c", command, folder=PACKAGE_DIR.parent)


def compare() -> None:
    """Compare small models before and after they are compiled, by the kernels of CPUs and in the form of GPUs."""
    graphs = []

    def counting(graph: torch.fx.GraphModule, inputs: list) -> torch.fx.GraphModule:
        graphs.append(graph)
        return torch._dynamo.lookup_backend("aot_eager")(graph, inputs)

    torch._dynamo.register_backend(counting, name="counting")
    compare_scenes(graphs)
    for module, name in OPERATORS:
        setattr(module, name, REFERENCES[getattr(module, name).name().removeprefix("nerfro::")])
    compare_scenes(graphs)


def compare_scenes(graphs: list[torch.fx.GraphModule]) -> None:
    for experiment, num_graphs in NUM_GRAPHS.items():
        torch._dynamo.reset()
        graphs.clear()
        options = [f"+experiment={experiment}", *SMALL, "data.downscale=16"]
        config = composed(*options, *shrunk(composed(*options)))
        views = build(config.data).load("train")
        model, rays = build_model(derived(config, build_medium(config), views)), views.cameras.image_rays(0)
        paths = [model.trace(rays[:-few]) for few in (1, 7, 13, 24)]
        expected, names = [results(model, path) for path in paths], model.state_dict().keys()
        model.scene.compile_radiance("counting")
        torch.testing.assert_close([results(model, path) for path in paths], expected, rtol=1e-3, atol=1e-5)
        assert len(graphs) == num_graphs
        assert model.state_dict().keys() == names


def results(model: Renderer, path: Path) -> tuple[torch.Tensor, list[torch.Tensor | None]]:
    """Return the radiance of the rays of paths, and gradients of all parameters."""
    model.zero_grad()
    radiance = model.render_path(path)[-1].radiance
    radiance.square().mean().backward()
    return radiance, [parameter.grad for parameter in model.parameters()]


def test_unknown_backend_is_refused_with_the_known_ones() -> None:
    with pytest.raises(NerfroError, match=r"compile=inductr is not a backend of torch.compile; set one of .*inductor"):
        require_backend("inductr", torch.device("cpu"))


def test_backend_that_fails_is_refused() -> None:
    def fails(graph: torch.fx.GraphModule, inputs: list) -> torch.fx.GraphModule:
        raise RuntimeError("No compiler found\nin any folder")

    torch._dynamo.register_backend(fails, name="fails")
    with pytest.raises(NerfroError, match=r"compile=fails fails on this machine \(.*No compiler found\); leave it out"):
        require_backend("fails", torch.device("cpu"))
