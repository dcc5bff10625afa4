"""The LLVM library of Dr.Jit: an old or missing library costs time but does not end the process."""

from pathlib import Path

import pytest

from nerfro.synthetic import llvm
from tests.processes import python

newest, version_in_name = llvm.newest, llvm.version_in_name

# Old libraries of this machine; Dr.Jit accepts LLVM 15, but aborts the process when it compiles with it.
OLD = sorted(str(file) for file in Path("/usr/lib").glob("*/libLLVM*.so.*") if (version_in_name(file) or 99) < 16)
RENDER = """
from nerfro.registry.registration import discover
discover()
from nerfro.synthetic.path_tracer import PathTracer, Pinhole
from nerfro.synthetic.synthesis import find_scene
from nerfro.synthetic.dataset import look_at_origin
tracer = PathTracer(find_scene("torus").build(0.3), False, Pinhole.square(0.7, 2))
print(tracer.mitsuba.variant(), tracer.render(look_at_origin([0, 0.1, 4]), spp=1, seed=0).mean() > 0)
"""


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-15.so.1", 15),
        ("libLLVM-14.0.6.so.1", 14),
        ("libLLVM.so.19.1", 19),
        ("libLLVM.so", None),
        ("libLLVM.dylib", None),
        ("libLTO.so.19.1", None),
    ],
)
def test_file_name_states_the_version(name: str, version: int | None) -> None:
    assert version_in_name(Path(name)) == version


def test_newest_supported_library_is_chosen() -> None:
    old = [Path("libLLVM-14.so.1"), Path("libLLVM-15.so.1"), Path("libLLVM.so")]
    assert newest([]) is None
    assert newest(old) is None
    assert newest([Path("libLLVM.so.19.1"), *old, Path("libLLVM.so.18.1")]) == Path("libLLVM.so.19.1")


@pytest.mark.slow
@pytest.mark.parametrize("library", ["/missing/libLLVM.so", *OLD[-1:]])
def test_without_a_usable_library_a_scene_is_rendered_by_the_scalar_variant(library: str) -> None:
    """In a process of its own, because Dr.Jit loads a library only once."""
    llvm.select_llvm()  # before Mitsuba is imported, which loads the library at once
    pytest.importorskip("mitsuba")
    result = python("-c", RENDER, DRJIT_LIBLLVM_PATH=library, CUDA_VISIBLE_DEVICES="")
    assert result.stdout.split() == ["scalar_rgb", "True"], result.stderr
    (line,) = (line for line in result.stderr.splitlines() if line.startswith("nerfro:"))
    assert "seventy times slower, because Dr.Jit" in line
    assert "install LLVM 16 or newer" in line
