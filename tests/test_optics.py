"""Comparison of path samplers with closed forms, by `nerfro.testing.check_optics` and `nerfro check`."""

import math

import pytest

from nerfro.core.types import Path, Rays
from nerfro.media.base import Medium
from nerfro.paper.eikonal import Eikonal
from nerfro.registry.registration import discover, find, register
from nerfro.samplers.base import PathSampler, straight_path
from nerfro.samplers.paths.snell import Snell
from nerfro.testing import ContractError, check, check_optics
from tests.conftest import Runner


@pytest.mark.parametrize("sampler", [Snell(), Snell("mesh"), Snell(branches="all")], ids=["sdf", "mesh", "branches"])
def test_snell_agrees_with_closed_forms(sampler: Snell, capsys: pytest.CaptureFixture[str]) -> None:
    rows = {(row.body, row.rays): row for row in check_optics(sampler)}
    assert len(rows) == 12
    ball = rows["ball", "impact 0.5"]
    # sin i = 0.5 and sin t = 0.5 / 1.5
    assert ball.deviation == pytest.approx(2 * (30 - math.degrees(math.asin(1 / 3))), abs=1e-4)
    assert max(row.largest for row in rows.values() if not row.refusal) < 0.05
    assert rows["slab", "incidence 40"].deviation < 1e-9
    assert all(row.refusal for (body, _), row in rows.items() if body == "luneburg")
    assert f"{ball.deviation:.3f}" in capsys.readouterr().out


def test_adaptive_steps_agree_with_closed_forms_and_long_steps_are_refused() -> None:
    rows = check_optics(Eikonal())
    assert not any(row.refusal for row in rows)
    assert max(row.largest for row in rows) < 0.05
    with pytest.raises(ContractError, match=r"take steps of medium\.step_length .* and jump by medium\.clearance"):
        check_optics(Eikonal("euler", num_steps=24))


class Straight(PathSampler):
    """Leave rays straight."""

    def forward(self, rays: Rays, medium: Medium) -> Path:
        return straight_path(rays)


def test_check_refuses_a_sampler_that_ignores_the_medium(restored_registry: None) -> None:
    register("sampler/path", "ignorant")(Straight)
    with pytest.raises(ContractError, match="set needs_medium = False if the sampler ignores the medium"):
        check(find("sampler/path", "ignorant"))
    with pytest.raises(ContractError, match="are wrong by"):
        check_optics(Straight())


def test_command_checks_plugins_with_settings(run_here: Runner) -> None:
    discover()
    out = run_here("check", "sampler/path=snell", "sampler.path.max_events=8", "background=constant", "export=sky").out
    assert "sampler/path=snell" in out
    assert "prism    incidence 40" in out
    assert "background=constant" in out
    assert "keeps the contract of exports" in out
    assert "is no setting of a plugin to check" in run_here("check", "field=nerf", "camera.x=1", code=1).error
    assert "name a plugin to check" in run_here("check", code=1).error
