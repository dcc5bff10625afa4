"""Alignment of cameras and their shared lens to a known scene, its sky and its masks."""

import math
from dataclasses import replace

import pytest
import torch
import trimesh
from torch import Tensor

from benchmarks.cameras import disturbed
from nerfro.camera.refined import gauss_newton
from nerfro.camera.refined.gauss_newton import PriorInformation
from nerfro.camera.refined.outlines import align_to_outlines
from nerfro.camera.refined.panorama import PanoramaSettings, align
from nerfro.camera.refined.refined import RefinedCamera, motion_between
from nerfro.core.cameras import Cameras
from nerfro.core.light import to_linear, to_srgb
from nerfro.core.rays import Rays
from nerfro.geometry.interpolation import misses
from nerfro.geometry.mesh import TriangleMesh
from nerfro.samplers.paths.snell import Snell
from nerfro.silhouettes.visual_hull import Silhouettes
from tests.ball_photographs import BOX, NUM_VIEWS, RADIUS, SIZE, cameras, photographs, sky, soft_masks, solid
from tests.conftest import refused
from tests.pretended_gpu import GPU, PretendedGpu

MEDIUM = solid([1.45])
PHOTOGRAPHS = photographs([1.45]).images.reshape(-1, 3)
TRUE = cameras()
# By half a degree, which is a quarter of a pixel, and 1 % of the distance.
DISTURBED = replace(TRUE, camera_to_world=disturbed(TRUE, math.radians(0.5), 0.01, 0).float())


def shown(rays: Rays, view: Tensor) -> Tensor:
    """A ball of glass before a smooth sky."""
    return to_srgb(sky(Snell()(rays, MEDIUM).exit_directions))


def photographed(pixels: Tensor) -> Tensor:
    return PHOTOGRAPHS[pixels]


def pixels_of_step(step: int, num: int = 300) -> Tensor:
    generator = torch.Generator().manual_seed(step)
    drawn = torch.randint(SIZE * SIZE, (NUM_VIEWS, 2 * num), generator=generator)
    pixels = drawn + SIZE * SIZE * torch.arange(NUM_VIEWS)[:, None]
    return gauss_newton.informative_pixels(pixels, num, photographed, TRUE)


def steps(camera: RefinedCamera, given: Cameras, num: int) -> None:
    camera.begin(given)
    settings = gauss_newton.Step(difference_pixels=0.5, scale=0.3, max_pixels=3.0)
    for step in range(num):
        gauss_newton.gauss_newton_step(camera, given, pixels_of_step(step), photographed, shown, settings)


def test_photometric_steps_recover_disturbed_cameras() -> None:
    camera = RefinedCamera(fix_gauge=False)
    steps(camera, DISTURBED, 6)
    before = motion_between(TRUE.camera_to_world, DISTURBED.camera_to_world)
    after = motion_between(TRUE.camera_to_world, camera.estimated(DISTURBED).camera_to_world)
    for old, new in zip(before, after, strict=True):
        assert float(new.median()) < 0.06 * float(old.median())


def test_photometric_steps_recover_the_shared_lens() -> None:
    given = replace(TRUE, fx=1.02 * TRUE.fx, fy=1.02 * TRUE.fy, cx=TRUE.cx + 0.5, cy=TRUE.cy - 0.3)
    camera = RefinedCamera(lens=True, fix_gauge=False)
    steps(camera, given, 8)
    found = camera.estimated(given)
    assert float(found.fx[0]) == pytest.approx(float(TRUE.fx[0]), rel=2e-3)
    assert float(found.cx[0]) == pytest.approx(float(TRUE.cx[0]), abs=0.1)
    assert float(found.cy[0]) == pytest.approx(float(TRUE.cy[0]), abs=0.1)


def test_steps_are_zero_at_the_true_cameras_and_bounded() -> None:
    camera = RefinedCamera(fix_gauge=False)
    camera.begin(TRUE)
    wrong = 1 - PHOTOGRAPHS

    def inverted(pixels: Tensor) -> Tensor:
        return wrong[pixels]

    far = gauss_newton.Step(difference_pixels=0.5, scale=10.0, max_pixels=0.25)
    gauss_newton.gauss_newton_step(camera, TRUE, pixels_of_step(0), inverted, shown, far)
    assert float(camera.motion.norm(dim=-1).max()) == pytest.approx(0.25, rel=1e-4)
    camera.begin(TRUE)
    gauss_newton.gauss_newton_step(
        camera, TRUE, pixels_of_step(0), photographed, shown, gauss_newton.Step(0.5, 0.3, 3.0)
    )
    assert float(camera.motion.abs().max()) < 1e-4


def test_informative_pixels_have_contrast() -> None:
    pictures = PHOTOGRAPHS.view(NUM_VIEWS, SIZE, SIZE, 3).clone()
    pictures[:, :, : SIZE // 2] = 0.5
    flat = pictures.view(-1, 3)
    drawn = torch.randint(SIZE * SIZE, (NUM_VIEWS, 400)) + SIZE * SIZE * torch.arange(NUM_VIEWS)[:, None]
    chosen = gauss_newton.informative_pixels(drawn, 50, lambda pixels: flat[pixels], TRUE)
    assert chosen.shape == (50 * NUM_VIEWS,)
    assert (chosen.view(NUM_VIEWS, 50) // SIZE**2 == torch.arange(NUM_VIEWS)[:, None]).all()
    assert float((chosen % SIZE >= SIZE // 2 - 1).float().mean()) > 0.95


def test_resumed_step_on_a_gpu_uses_the_prior_of_a_cpu_checkpoint() -> None:
    """A camera whose prior is certain stays."""
    camera = RefinedCamera(fix_gauge=False)
    camera.begin(TRUE)
    size = camera.parameter_vector().numel()
    prior = PriorInformation(torch.zeros(size), 1e12 * torch.eye(size).double())
    with PretendedGpu():
        camera, given = camera.to(GPU), TRUE.to(GPU)
        pixels, pictures = pixels_of_step(0, 20).to(GPU), 1 - PHOTOGRAPHS.to(GPU)
        sky_alone = lambda rays, view: to_srgb(sky(rays.directions))  # noqa: E731
        step = gauss_newton.Step(difference_pixels=0.5, scale=10.0, max_pixels=0.25)
        gauss_newton.gauss_newton_step(camera, given, pixels, lambda chosen: pictures[chosen], sky_alone, step, [prior])
        assert float(camera.motion.abs().max()) < 1e-4


def panorama(
    camera: RefinedCamera,
    given: Cameras,
    box: Tensor = BOX,
    gains: Tensor | None = None,
    settings: PanoramaSettings | None = None,
) -> PriorInformation | None:
    def photographed(pixels: Tensor) -> Tensor:
        colours = PHOTOGRAPHS[pixels]
        view = pixels // (TRUE.height * TRUE.width)
        return colours if gains is None else to_srgb(to_linear(colours) * gains[view, None])

    camera.begin(given)
    return align(camera, given, photographed, lambda rays: misses(box, rays), settings or PanoramaSettings())


def rotation_errors(camera: RefinedCamera) -> Tensor:
    """Rotation errors of the cameras in degrees, without the common rotation."""
    axes, true = (poses[..., :3].double() for poses in (camera.moved(), TRUE.camera_to_world))
    u, _, vt = torch.linalg.svd((axes @ true.mT).mean(0))
    between = (u @ vt).T @ axes @ true.mT
    cosine = 0.5 * (between.diagonal(dim1=1, dim2=2).sum(-1) - 1)
    return torch.rad2deg(torch.arccos(cosine.clamp(max=1)))


@pytest.mark.parametrize("brightness", [0.0, 0.15])
def test_sky_alignment_recovers_rotations(brightness: float) -> None:
    """Half a degree is a quarter of a pixel. Shifts of cameras and other exposures do not disturb."""
    gains = 0.6 * torch.exp(brightness * torch.randn(NUM_VIEWS, generator=torch.Generator().manual_seed(0)))
    camera = RefinedCamera(exposure=brightness > 0)
    assert panorama(camera, DISTURBED, gains=gains) is not None
    assert not bool(camera.motion[:, 3:].any())
    assert float(rotation_errors(camera).median()) < (0.03 if brightness == 0 else 0.06)


def test_memory_of_the_sky_alignment_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """No projection has more points than directions are allowed, and fewer directions suffice."""
    sizes, project = list[int](), Cameras.project

    def record(cameras: Cameras, points: Tensor) -> tuple[Tensor, Tensor]:
        sizes.append(len(cameras) * len(points))
        return project(cameras, points)

    monkeypatch.setattr(Cameras, "project", record)
    camera = RefinedCamera()
    panorama(camera, DISTURBED, settings=PanoramaSettings(max_directions=100 * NUM_VIEWS))
    assert 50 * NUM_VIEWS < max(sizes) <= 100 * NUM_VIEWS
    assert float(rotation_errors(camera).median()) < 0.06


def test_sky_alignment_recovers_the_shared_focal_length() -> None:
    given = replace(TRUE, fx=1.02 * TRUE.fx, fy=1.02 * TRUE.fy)
    camera = RefinedCamera(lens=True)
    assert panorama(camera, given) is not None
    assert float(camera.estimated(given).fx[0]) == pytest.approx(float(TRUE.fx[0]), rel=2e-3)


def test_sky_alignment_has_no_result_without_sky_pixels() -> None:
    camera = RefinedCamera()
    assert panorama(camera, TRUE, box=10 * BOX) is None
    assert not bool(camera.motion.any())


def ellipsoid() -> TriangleMesh:
    made = trimesh.creation.icosphere(4, RADIUS)
    return TriangleMesh(made.vertices * [1.0, 0.75, 0.55], made.faces)


def silhouettes() -> Silhouettes:
    return Silhouettes.of(TRUE, soft_masks(ellipsoid()))


def aligned(
    camera: RefinedCamera, given: Cameras, seen: Silhouettes, fixed: list[int] | None = None
) -> PriorInformation:
    """Align cameras to outlines; a prior fixes some of the six motion parameters of each camera."""
    camera.begin(given)
    precision = torch.zeros_like(camera.motion)
    precision[:, fixed or []] = 1e6
    mean = camera.parameter_vector()
    information = torch.nn.functional.pad(precision.flatten(), (0, len(mean) - precision.numel())).diag()
    prior = [PriorInformation(mean, information)]
    posterior = align_to_outlines(camera, given, seen, ellipsoid(), prior)
    assert posterior is not None
    return posterior


def projection_error(given: Cameras) -> float:
    """Median displacement of projected points of the surface, pixels."""
    points = torch.from_numpy(ellipsoid().vertices[::20]).float()
    return float((given.project(points)[0] - TRUE.project(points)[0]).norm(dim=-1).median())


@pytest.mark.parametrize("too_wide", [0.0, 0.4])
def test_outline_alignment_recovers_disturbed_cameras(too_wide: float) -> None:
    """From half a degree and 1 %, also where all masks are too wide by less than half a pixel."""
    camera, seen = RefinedCamera(), silhouettes()
    aligned(camera, DISTURBED, replace(seen, distances=seen.distances + too_wide))
    assert projection_error(camera.estimated(DISTURBED)) < 0.15 * projection_error(DISTURBED)


def test_outline_alignment_does_not_move_cameras_to_a_wrong_surface(capsys: pytest.CaptureFixture[str]) -> None:
    camera = RefinedCamera()
    camera.begin(TRUE)
    other = TriangleMesh(ellipsoid().vertices[:, [1, 0, 2]], ellipsoid().faces[:, ::-1])
    assert align_to_outlines(camera, TRUE, silhouettes(), other) is None
    assert not bool(camera.motion.any())
    assert "pixels off its masks" in capsys.readouterr().out


def test_outline_alignment_refuses_empty_masks() -> None:
    camera = RefinedCamera()
    camera.begin(TRUE)
    nothing = Silhouettes.of(TRUE, torch.zeros(NUM_VIEWS, SIZE, SIZE))
    refused("belong together", align_to_outlines, camera, TRUE, nothing, ellipsoid())


def test_outline_alignment_recovers_the_principal_point_of_known_cameras() -> None:
    given = replace(TRUE, cx=TRUE.cx + 0.4, cy=TRUE.cy - 0.3)
    camera = RefinedCamera(lens=True)
    aligned(camera, given, silhouettes(), [0, 1, 2, 3, 4, 5])
    found = camera.estimated(given)
    assert float(found.cx[0]) == pytest.approx(float(TRUE.cx[0]), abs=0.03)
    assert float(found.cy[0]) == pytest.approx(float(TRUE.cy[0]), abs=0.03)


def test_outlines_do_not_separate_rotation_from_translation() -> None:
    """A shift is determined to 0.05 pixels, but a compensating rotation hardly changes the outlines."""
    camera = RefinedCamera()
    posterior = aligned(camera, TRUE, silhouettes())
    assert projection_error(camera.estimated(TRUE)) < 0.05
    of_view = torch.stack([posterior.information[6 * v : 6 * v + 6, 6 * v : 6 * v + 6] for v in range(NUM_VIEWS)])
    assert torch.equal(of_view, of_view.mT) or torch.allclose(of_view, of_view.mT, rtol=1e-3)
    # A shift along x, and the same shift with a rotation about y in either direction.
    shift, left = torch.tensor([0.0, 0, 0, 1, 0, 0]), torch.tensor([0.0, 1, 0, 1, 0, 0])
    right = torch.tensor([0.0, -1, 0, 1, 0, 0])
    of_shift = of_view @ shift @ shift
    assert float(of_shift.median()) > 1 / 0.05**2
    assert float((torch.minimum(*(of_view @ motion @ motion for motion in (left, right))) / of_shift).max()) < 0.1
