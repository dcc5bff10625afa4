"""Ground truth with partial reflection (`fresnel=true`) against Fresnel's equations; energy and radiance are kept."""

import numpy as np
import pytest

from nerfro.synthetic import glass
from nerfro.synthetic.dataset import look_at_origin
from nerfro.synthetic.path_tracer import PathTracer, Pinhole, load_mitsuba
from nerfro.synthetic.scene import rounded_box
from tests.synthetic.empty_glass import empty_glass

pytestmark = pytest.mark.usefixtures("mitsuba")


def reflectances(angles, n):
    """Fresnel's equations from air into glass: for light across and in the plane of incidence."""
    cosine, sine = np.cos(angles), np.sin(angles)
    inside = np.sqrt(1 - (sine / n) ** 2)
    across = ((cosine - n * inside) / (cosine + n * inside)) ** 2
    within = ((n * cosine - inside) / (n * cosine + inside)) ** 2
    return across, within


def sampled(n, angles, number, from_inside=False):
    """Probability, weight and new cosine of one of the two events of nerfro's material, for rays at some angles."""
    mi = load_mitsuba()
    bsdf = mi.load_dict({"type": glass.PLUGIN, "int_ior": n, "fresnel": True})
    interaction = mi.SurfaceInteraction3f()
    interaction.t = 1.0
    sign = -1.0 if from_inside else 1.0
    columns = [np.sin(angles), 0 * angles, sign * np.cos(angles)]
    interaction.wi = mi.Vector3f(*(mi.Float(column.astype(np.float32)) for column in columns))
    sample, weight = bsdf.sample(mi.BSDFContext(), interaction, mi.Float(number), mi.Point2f(0.5), True)
    return np.asarray(sample.pdf), np.asarray(weight)[0], np.asarray(sample.wo)[2]


@pytest.mark.parametrize(("n", "percent"), [(1.52, 4.26), (1.33, 2.01)])
def test_reflected_and_transmitted_shares_are_fresnels_and_sum_to_one(n, percent):
    brewster = np.arctan(n)
    angles = np.array([0.0, 0.3, 0.7, brewster, 1.3, 1.5, np.radians(89.99)])
    reflected, weight, cosine = sampled(n, angles, 0.0)
    assert (cosine > 0).all()
    assert weight == pytest.approx(1, abs=1e-5)
    across, within = reflectances(angles, n)
    assert reflected == pytest.approx(0.5 * (across + within), abs=2e-5)
    assert reflected[0] == pytest.approx(((n - 1) / (n + 1)) ** 2, abs=1e-6)
    assert 100 * reflected[0] == pytest.approx(percent, abs=0.006)
    # At Brewster's angle, tan i = n, nothing in the plane of incidence is reflected: half of the rest is left.
    assert within[3] == pytest.approx(0, abs=1e-15)
    assert reflected[3] == pytest.approx(0.5 * ((n * n - 1) / (n * n + 1)) ** 2, abs=1e-5)
    assert reflected[-1] > 0.99
    transmitted, weight, cosine = sampled(n, angles, 1.0 - 1e-6)
    assert (cosine < 0).all()
    assert reflected + transmitted == pytest.approx(1, abs=1e-6)
    assert weight == pytest.approx(1, abs=1e-5)


def test_reflectance_is_symmetric_and_total_beyond_the_critical_angle():
    n = 1.52
    angles = np.array([0.0, 0.3, 0.8, 1.3])
    inside = np.arcsin(np.sin(angles) / n)
    entering, _, _ = sampled(n, angles, 1.0 - 1e-6)
    leaving, _, _ = sampled(n, inside, 1.0 - 1e-6, from_inside=True)
    assert leaving == pytest.approx(entering, abs=1e-5)  # Fresnel's shares are the same both ways
    totally, _, _ = sampled(n, np.array([np.arcsin(1 / n) + 0.01, 1.2]), 0.0, from_inside=True)
    assert totally == pytest.approx(1, abs=1e-6)


def test_transmittance_of_a_slab_sums_infinitely_many_reflections():
    """White in front of the camera, black behind it: T = 2 n / (n^2 + 1) at normal incidence."""
    n = 1.52
    slab = rounded_box((1.5, 1.5, 0.05), 0.01, edge_steps=2)
    scene = empty_glass(slab, lambda directions: np.repeat((directions[..., 2:] < 0).astype(float), 3, -1), ior=n)
    tracer = PathTracer(scene, True, Pinhole.square(0.05, 8))
    picture = tracer.render(look_at_origin(np.array([0.0, 1e-3, 4.0])), spp=1024, seed=0)
    # 65536 paths, each black or white: a standard deviation of 0.001.
    assert picture.mean() == pytest.approx(2 * n / (n * n + 1), abs=4e-3)
