"""Mitsuba materials for transmission, reflection and absorption of glass."""

from __future__ import annotations

import functools
from typing import Any

from nerfro.core.errors import optional
from nerfro.synthetic.llvm import PURPOSE

PLUGIN = "transmitting_glass"
EMBEDDED = "embedded_in_glass"


@functools.cache
def register_materials(variant: str) -> None:
    """Register two BSDFs for the active Mitsuba variant, whose base class they derive from.

    `transmitting_glass` is the image formation of the paper, with one path per ray. Below the critical angle, a ray is
    transmitted by Snell's law without loss: there is neither partial Fresnel reflection nor scaling by n^2. The scaling
    cancels, because both ends of every path lie in air. Above the critical angle, a ray is reflected totally. With
    `fresnel`, the material also reflects partially, like Mitsuba's dielectric.
    Parameters: `int_ior` and `ext_ior` (floats; the latter is 1 by default), `tint` (linear RGB factor for each
    transmission), `fresnel` (bool), and `absorption` (RGB per world unit), which attenuates light that reaches the
    surface from inside; `outer_absorption` attenuates light from outside, for a body within another one.

    `embedded_in_glass` is the nested BSDF of an object inside the body, attenuated in the same way (`absorption`).
    Together, the two materials attenuate every segment of a path inside the body at its end.
    """
    dr, mi = (optional(name, "synthesize", PURPOSE) for name in ("drjit", "mitsuba"))
    mi.register_bsdf(PLUGIN, _transmitting_glass(mi, dr))
    mi.register_bsdf(EMBEDDED, _embedded_in_glass(mi, dr))


def _transmitting_glass(mi: Any, dr: Any) -> type:
    class TransmittingGlass(mi.BSDF):
        def __init__(self, properties: mi.Properties) -> None:
            super().__init__(properties)
            self.ior = mi.Float(properties.get("int_ior", 1.5) / properties.get("ext_ior", 1.0))
            self.tint = mi.Color3f(properties.get("tint", mi.ScalarColor3f(1.0)))
            self.absorption = mi.Color3f(properties.get("absorption", mi.ScalarColor3f(0.0)))
            self.outer_absorption = mi.Color3f(properties.get("outer_absorption", mi.ScalarColor3f(0.0)))
            self.fresnel = bool(properties.get("fresnel", False))
            sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            reflection = mi.BSDFFlags.DeltaReflection | sides
            transmission = mi.BSDFFlags.DeltaTransmission | sides | mi.BSDFFlags.NonSymmetric
            self.m_components = [reflection, transmission]
            self.m_flags = reflection | transmission

        def sample(self, context, interaction, sample1, sample2, active=True):
            cosine = mi.Frame3f.cos_theta(interaction.wi)
            share, cos_transmitted, eta, inverse_eta = mi.fresnel(cosine, self.ior)
            total = cos_transmitted == 0  # mi.fresnel returns the cosine 0 above the critical angle
            share = dr.select(total, mi.Float(1.0), share if self.fresnel else mi.Float(0.0))
            reflected = sample1 < share
            sampled = mi.BSDFSample3f()
            sampled.wo = dr.select(
                reflected, mi.reflect(interaction.wi), mi.refract(interaction.wi, cos_transmitted, inverse_eta)
            )
            sampled.pdf = dr.select(reflected, share, 1.0 - share)
            sampled.eta = dr.select(reflected, mi.Float(1.0), eta)
            sampled.sampled_component = dr.select(reflected, mi.UInt32(0), mi.UInt32(1))
            sampled.sampled_type = dr.select(
                reflected, mi.UInt32(+mi.BSDFFlags.DeltaReflection), mi.UInt32(+mi.BSDFFlags.DeltaTransmission)
            )
            # A negative cosine means that the ray reaches the surface from inside.
            absorption = dr.select(cosine < 0, self.absorption, self.outer_absorption)
            value = dr.select(reflected, mi.Color3f(1.0), self.tint)
            # Camera rays in air start outside; 0 times an infinite distance would not be a number.
            value *= dr.select(absorption > 0, dr.exp(-absorption * interaction.t), 1.0)
            return sampled, mi.Spectrum(value) & active

        def eval(self, context, interaction, wo, active=True):
            return mi.Spectrum(0.0)

        def pdf(self, context, interaction, wo, active=True):
            return mi.Float(0.0)

        def eval_pdf(self, context, interaction, wo, active=True):
            return mi.Spectrum(0.0), mi.Float(0.0)

        def to_string(self) -> str:
            return f"TransmittingGlass[ior={self.ior}, tint={self.tint}]"

    return TransmittingGlass


def _embedded_in_glass(mi: Any, dr: Any) -> type:
    class EmbeddedInGlass(mi.BSDF):
        def __init__(self, properties: mi.Properties) -> None:
            super().__init__(properties)
            self.absorption = mi.Color3f(properties.get("absorption", mi.ScalarColor3f(0.0)))
            self.nested = properties["nested"]
            self.m_components = [self.nested.flags(index) for index in range(self.nested.component_count())]
            self.m_flags = self.nested.flags()

        def _through(self, interaction):
            return mi.Spectrum(dr.exp(-self.absorption * interaction.t))

        def sample(self, context, interaction, sample1, sample2, active=True):
            sampled, value = self.nested.sample(context, interaction, sample1, sample2, active)
            return sampled, value * self._through(interaction)

        def eval(self, context, interaction, wo, active=True):
            return self.nested.eval(context, interaction, wo, active) * self._through(interaction)

        def pdf(self, context, interaction, wo, active=True):
            return self.nested.pdf(context, interaction, wo, active)

        def eval_pdf(self, context, interaction, wo, active=True):
            value, pdf = self.nested.eval_pdf(context, interaction, wo, active)
            return value * self._through(interaction), pdf

        def to_string(self) -> str:
            return f"EmbeddedInGlass[absorption={self.absorption}, {self.nested}]"

    return EmbeddedInGlass
