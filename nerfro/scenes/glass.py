"""A Mitsuba material that transmits, or reflects totally, and does nothing in between."""

from __future__ import annotations

import functools

PLUGIN = "transmitting_glass"


@functools.cache
def register_transmitting_glass(variant: str) -> None:
    """Register the BSDF `transmitting_glass` for a Mitsuba variant, which must be the active one: its base class is.

    A ray that meets the surface below the critical angle is transmitted as Snell's law says and keeps its radiance:
    there is no partial Fresnel reflection, and no scaling by n^2, which cancels anyway as both ends of every path lie
    in air. Above the critical angle it is reflected totally. That is the paper's image formation: one path per ray.

    Parameters of the plugin: `ior` (float, inside over outside) and `tint` (linear RGB factor per transmission).
    """
    import drjit as dr
    import mitsuba as mi

    class TransmittingGlass(mi.BSDF):
        def __init__(self, properties: mi.Properties) -> None:
            super().__init__(properties)
            self.ior = mi.Float(properties.get("ior", 1.5))
            self.tint = mi.Color3f(properties.get("tint", mi.ScalarColor3f(1.0)))
            sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            reflection = mi.BSDFFlags.DeltaReflection | sides
            transmission = mi.BSDFFlags.DeltaTransmission | sides | mi.BSDFFlags.NonSymmetric
            self.m_components = [reflection, transmission]
            self.m_flags = reflection | transmission

        def sample(self, context, interaction, sample1, sample2, active=True):
            _, cos_transmitted, eta, inverse_eta = mi.fresnel(mi.Frame3f.cos_theta(interaction.wi), self.ior)
            total = cos_transmitted == 0  # mi.fresnel returns the cosine 0 above the critical angle
            sampled = mi.BSDFSample3f()
            sampled.wo = dr.select(
                total, mi.reflect(interaction.wi), mi.refract(interaction.wi, cos_transmitted, inverse_eta)
            )
            sampled.pdf = mi.Float(1.0)
            sampled.eta = dr.select(total, mi.Float(1.0), eta)
            sampled.sampled_component = dr.select(total, mi.UInt32(0), mi.UInt32(1))
            sampled.sampled_type = dr.select(
                total, mi.UInt32(+mi.BSDFFlags.DeltaReflection), mi.UInt32(+mi.BSDFFlags.DeltaTransmission)
            )
            value = dr.select(total, mi.Color3f(1.0), self.tint)
            return sampled, mi.Spectrum(value) & active

        def eval(self, context, interaction, wo, active=True):
            return mi.Spectrum(0.0)

        def pdf(self, context, interaction, wo, active=True):
            return mi.Float(0.0)

        def eval_pdf(self, context, interaction, wo, active=True):
            return mi.Spectrum(0.0), mi.Float(0.0)

        def to_string(self) -> str:
            return f"TransmittingGlass[ior={self.ior}, tint={self.tint}]"

    mi.register_bsdf(PLUGIN, TransmittingGlass)
