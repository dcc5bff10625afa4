"""Kernels compile in any installation folder, and again after a change of their sources."""

import math
import os
import sys
import types
from collections import namedtuple
from pathlib import Path

import numba
import pytest

import nerfro.fields.hash_encoding  # noqa: F401  # whose sources are listed
from nerfro.kernels import compilation
from nerfro.kernels.compilation import compiled, compiled_parallel
from nerfro.samplers.paths import snell_cpu, surface_search_cpu
from tests.processes import printed_by


def _square(x: float) -> float:
    return x * x


def test_machine_code_is_kept_in_the_cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path))
    before = numba.config.CACHE_DIR
    assert compiled(_square)(3.0) == 9.0
    assert list(tmp_path.rglob("*.nbi"))
    # Other packages' kernels are none of our business.
    assert before == numba.config.CACHE_DIR


def test_kernels_contain_the_code_of_the_functions_of_a_ray() -> None:
    """The compiler by itself calls the longer ones, with many numbers in memory, which takes 1.2 times as long."""
    for function in (surface_search_cpu.first_surface, snell_cpu._follow):
        assert function.targetoptions["forceinline"]


def test_kernels_work_without_a_writable_folder_with_one_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path / "file" / "below"))
    compilation._warn_of_compiling.cache_clear()
    in_tree = set(Path(__file__).parent.rglob("*.nbi"))
    assert compiled(_square)(3.0) == 9.0
    assert compiled_parallel(_square)(3.0) == 9.0
    (line,) = "".join(capsys.readouterr()).splitlines()
    assert str(tmp_path / "file" / "below") in line
    assert "set NERFRO_CACHE to a folder that can be written" in line
    assert set(Path(__file__).parent.rglob("*.nbi")) == in_tree


def _length(vector: tuple[float, float]) -> float:
    return math.hypot(vector[0], vector[1])


def test_kernel_is_recompiled_if_the_class_of_an_argument_has_moved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path))
    for name in ("module_before", "module_after"):
        vector = namedtuple("Vector", ("x", "y"), module=name)
        with monkeypatch.context() as modules:
            modules.setitem(sys.modules, name, types.ModuleType(name))
            modules.setattr(sys.modules[name], "Vector", vector, raising=False)
            assert compiled(_length)(vector(3.0, 4.0)) == 5.0


@pytest.mark.slow
def test_kernel_is_recompiled_if_a_constant_of_another_file_changes(tmp_path: Path) -> None:
    package = tmp_path / "plugin"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "middle.py").write_text("from .numbers import FACTOR\n")
    (package / "kernel.py").write_text(
        "from nerfro.kernels.compilation import compiled\n"
        "from plugin.middle import FACTOR\n\n\n"
        "@compiled\ndef scaled(x):\n    return FACTOR * x\n"
    )
    environment = {"NERFRO_CACHE": str(tmp_path), "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    environment["PYTHONDONTWRITEBYTECODE"] = "1"  # two files of the same second look the same to Python
    for factor in (2, 5):
        (package / "numbers.py").write_text(f"FACTOR = {factor}\n")
        assert (
            printed_by("-c", "from plugin.kernel import scaled; print(scaled(3))", **environment) == f"{3 * factor}\n"
        )
