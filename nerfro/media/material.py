"""Materials of bodies: refractive index, dispersion and absorption, and a catalogue of published materials.

A dispersion gives the change of the index with the wavelength w in relation to the d line: (n(w) - n_d) / (n_d - 1). A
body with a learned or replaced index n_d therefore keeps the Abbe number of its material.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from nerfro.core.errors import NerfroError, nearest_of
from nerfro.registry.allowed import NotNegative, OnlyWith, Positive, validated

# Whether training learns a quantity of the medium, which only some path samplers trace.
Learns = Annotated[bool, OnlyWith("sampler.path", attribute="needs_medium")]

# Wavelengths of the lines d, F and C, nm.
_LINE_D, _LINE_F, _LINE_C = 587.56, 486.13, 656.27


class Dispersion(ABC):
    """Dependence of a refractive index on the wavelength."""

    @abstractmethod
    def __call__(self, wavelength: float) -> float:
        """Return (n(w) - n_d) / (n_d - 1) at a wavelength w in nm."""

    @property
    def abbe(self) -> float:
        """Abbe number V = (n_d - 1) / (n_F - n_C)."""
        return 1 / (self(_LINE_F) - self(_LINE_C))


@dataclass(frozen=True)
class Abbe(Dispersion):
    """Cauchy's two terms with a given Abbe number V: n(w) = n_d + B (1 / w^2 - 1 / w_d^2)."""

    number: float

    def __call__(self, wavelength: float) -> float:
        return (wavelength**-2 - _LINE_D**-2) / (_LINE_F**-2 - _LINE_C**-2) / self.number


@dataclass(frozen=True)
class Formula(Dispersion):
    """Published dispersion formula of a material.

    Attributes:
        description: the material, in words.
        source: publication of the formula.
    """

    description: str
    source: str

    @abstractmethod
    def index(self, micrometres: float) -> float:
        """Return the refractive index at a wavelength in air."""

    @property
    def ior(self) -> float:
        """Refractive index of the d line."""
        return self.index(_LINE_D / 1000)

    def __call__(self, wavelength: float) -> float:
        return (self.index(wavelength / 1000) - self.ior) / (self.ior - 1)


@dataclass(frozen=True)
class Sellmeier(Formula):
    """Sellmeier's formula: n^2 = 1 + constant + sum of b w^2 / (w^2 - c), for the wavelength w in micrometres.

    Attributes:
        terms: b, and c in square micrometres, of each term.
        constant: constant term.
    """

    terms: tuple[tuple[float, float], ...]
    constant: float = 0.0

    def index(self, micrometres: float) -> float:
        square = micrometres**2
        return (1 + self.constant + sum(b * square / (square - c) for b, c in self.terms)) ** 0.5


@dataclass(frozen=True)
class PowerSeries(Formula):
    """Sum of powers: n = sum of c w^p, for the wavelength w in micrometres.

    Attributes:
        terms: c and p of each term.
    """

    terms: tuple[tuple[float, int], ...]

    def index(self, micrometres: float) -> float:
        return sum(c * micrometres**power for c, power in self.terms)


# The values of the formulas are in the database of refractiveindex.info (public domain). Plugins may add entries.
MATERIALS: dict[str, Formula] = {
    "water": Sellmeier(
        "water at 20 °C",
        "Daimon and Masumura 2007, Appl. Opt. 46, 3811",
        (
            (5.684027565e-1, 5.101829712e-3), (1.726177391e-1, 1.821153936e-2), (2.086189578e-2, 2.620722293e-2),
            (1.130748688e-1, 1.069792721e1),
        ),
    ),
    "soda_lime": PowerSeries(
        "clear soda-lime glass (windows, bottles, drinking glasses)",
        "Rubin 1985, Sol. Energy Mater. 12, 275",
        ((1.5130, 0), (-0.003169, 2), (0.003962, -2)),
    ),
    "borosilicate": Sellmeier(
        "borosilicate glass 3.3 (laboratory glass, ovenware)",
        "Schott, BOROFLOAT 33, optical properties, 2021",
        ((0.78657, 0.10856**2), (0.18285, 4.427**2)),
        constant=0.3542,
    ),
    "n_bk7": Sellmeier(
        "optical glass N-BK7",
        "Schott, data sheet 2017",
        ((1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653)),
    ),
    "acrylic": Sellmeier(
        "acrylic glass (PMMA)", "Sultanova et al. 2009, Acta Phys. Pol. A 116, 585", ((1.1819, 0.011313),)
    ),
    "polycarbonate": Sellmeier(
        "polycarbonate", "Sultanova et al. 2009, Acta Phys. Pol. A 116, 585", ((1.4182, 0.021304),)
    ),
    "sapphire": Sellmeier(
        "sapphire, ordinary ray",
        "Malitson and Dodge 1972, J. Opt. Soc. Am. 62, 1405",
        ((1.4313493, 0.0726631**2), (0.65054713, 0.1193242**2), (5.3414021, 18.028251**2)),
    ),
    "diamond": Sellmeier("diamond", "Peter 1923, Z. Phys. 15, 358", ((0.3306, 0.1750**2), (4.3356, 0.1060**2))),
}  # fmt: skip


def find_material(name: str) -> Formula:
    """Return a material of the catalogue.

    Raises:
        NerfroError: the catalogue has no such material.
    """
    if name not in MATERIALS:
        raise NerfroError(
            f"'{name}' is not a material; {nearest_of(name, list(MATERIALS))} (python -m nerfro.plugins material)"
        )
    return MATERIALS[name]


@validated("material")
class Material(nn.Module):
    """Refractive index, dispersion and absorption of a body.

    Args:
        ior: refractive index of the d line, 587.6 nm.
        absorption: coefficients of red, green and blue, per world unit.
        dispersion: dependence of the index on the wavelength; None for one index at all wavelengths.
        learn: quantities that are learned: `ior`, `absorption`. Absorption starts from the given values, or from almost
            none.

    Attributes:
        absorption_length: if the absorption is learned, length in world units over which softplus of the parameter is
            an optical depth. It makes the training independent of the world unit, see `scale_absorption`.
    """

    ior: Float[Tensor, ""]
    absorption_length: Float[Tensor, ""]
    _absorption: Float[Tensor, "3"] | None  # a parameter is passed through softplus

    def __init__(
        self,
        ior: Positive,
        absorption: Sequence[NotNegative] = (0.0, 0.0, 0.0),
        dispersion: Dispersion | None = None,
        learn: Sequence[str] = (),
    ) -> None:
        super().__init__()
        self.dispersion = dispersion
        # Double precision, as the kernels need; scalar tensors do not promote float32 operands.
        index = torch.tensor(ior, dtype=torch.float64)
        coefficients = torch.tensor(absorption, dtype=torch.float32)
        if "ior" in learn:
            self.ior = nn.Parameter(index)
        else:
            self.register_buffer("ior", index, persistent=False)
        if "absorption" in learn:
            self._absorption, self._initial_absorption = nn.Parameter(coefficients.clone()), coefficients
            self.register_buffer("absorption_length", torch.tensor(1.0))
            self.scale_absorption(1.0)
        else:
            self.register_buffer("_absorption", coefficients if coefficients.any() else None, persistent=False)

    @torch.no_grad()
    def scale_absorption(self, length: float) -> None:
        """Set the parameter of a learned absorption to its initial value.

        Args:
            length: half of the longest side of the body, world units.
        """
        if isinstance(self._absorption, nn.Parameter):
            # With a larger initial optical depth across half of the body, the absorption would explain the content.
            depth = (self._initial_absorption * length).clamp(min=0.02)
            self._absorption.copy_(depth + torch.log(-torch.expm1(-depth)))  # inverse of softplus
            self.absorption_length.fill_(length)

    def learned(self) -> dict[str, nn.Parameter]:
        """Return the parameters of the learned quantities, `ior` and `absorption`."""
        quantities = {"ior": self.ior, "absorption": self._absorption}
        return {name: value for name, value in quantities.items() if isinstance(value, nn.Parameter)}

    @property
    def absorbs(self) -> bool:
        """Whether the material may absorb light."""
        return self._absorption is not None

    @property
    def absorption(self) -> Float[Tensor, "3"]:
        """Absorption coefficients of red, green and blue, per world unit."""
        if self._absorption is None:
            return torch.zeros(3, device=self.ior.device)
        if not isinstance(self._absorption, nn.Parameter):
            return self._absorption
        return softplus(self._absorption) / self.absorption_length

    def ior_at(self, wavelength: float) -> Float[Tensor, ""]:
        """Return the refractive index at a wavelength in nm, with gradients."""
        return self.ior + (self.ior - 1) * self.dispersion_at(wavelength)

    def dispersion_at(self, wavelength: float) -> float:
        """Return (n(w) - n_d) / (n_d - 1) at a wavelength w in nm; 0 without dispersion."""
        return 0.0 if self.dispersion is None else self.dispersion(wavelength)


def learned_quantities(ior: bool, absorption: bool) -> list[str]:
    """Return the names of the learned quantities of a material, see `Material`."""
    return ["ior"] * ior + ["absorption"] * absorption
