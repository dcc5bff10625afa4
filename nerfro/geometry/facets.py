"""Flat facets of a mesh, such as those of a cut stone, in contrast to triangles that sample a smooth surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from nerfro.core.provenance import AlgorithmSettings
from nerfro.geometry.orientation import area_vectors


@dataclass(frozen=True)
class FacetSettings(AlgorithmSettings):
    """Settings of the decision which faces are facets (`facets_of`).

    Attributes:
        crease_degrees: angle between faces above which edges are sharp; 30 is a common default of modelling programs.
        coplanar_degrees: angle between triangles of one flat face.
        least_share: share of the area of a mesh below which a region stays smooth.
        small: area of a face, relative to the typical face of its region, below which it belongs to a rounded edge.
        mixed: share of the edges, by length, at which neither two triangles nor two quadrilaterals meet, above which
            faces are cut.
        open: share of the edges, by length, above which a region ends at sharp edges.
        least_turn, doubtful_turn, faceted_turn: angles between faces, in degrees, above which faces differ, may be
            facets, and are facets. Cylinders of modelling programs have 30 or more sides.
    """

    crease_degrees: float = 30.0
    coplanar_degrees: float = 0.1
    least_share: float = 0.05
    small: float = 0.05
    mixed: float = 0.25
    open: float = 0.1
    least_turn: float = 2.0
    doubtful_turn: float = 8.0
    faceted_turn: float = 12.5


class Facets(NamedTuple):
    """Flat facets of a mesh.

    Attributes:
        number: number of the facet of each triangle; -1 for triangles of smooth surfaces.
        doubt: description of faces that may be facets or samples of a smooth surface; empty if there are none.
    """

    number: Int[np.ndarray, "F"]
    doubt: str


class _Edges(NamedTuple):
    """Edges between two triangles: both triangles, the angle between them in degrees, and the length."""

    first: Int[np.ndarray, " edges"]
    second: Int[np.ndarray, " edges"]
    angle: Float[np.ndarray, " edges"]
    length: Float[np.ndarray, " edges"]

    def subset(self, rows: Bool[np.ndarray, " edges"]) -> _Edges:
        return _Edges(*(column[rows] for column in self))


def facets_of(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "F 3"], settings: FacetSettings = FacetSettings()
) -> Facets:
    """Decide which faces of a mesh are facets with sharp edges, where the angles alone do not decide.

    Coplanar triangles form flat faces. A region consists of faces that are connected by edges below the crease angle.
    Samples of a smooth surface give triangles or a regular grid of quadrilaterals, whereas facets have different
    numbers of corners. Faces of a region are therefore facets if most of the region consists of faces of several
    triangles and many edges lie between faces of different numbers of corners. Rings and grids of large quadrilaterals
    that end at sharp edges are ambiguous, for example a tumbler of 20 sides; they are facets if the faces meet at 12.5
    degrees or more. Faces much smaller than the others belong to rounded edges.

    Args:
        vertices: world units; equal positions must be merged.
        faces: vertex indices of each triangle, outward faces counter-clockwise.
        settings: tuned numbers of the decision.
    """
    settings.use()
    edges = _edges(vertices, faces)
    face = _flat_faces(vertices, faces, edges, settings.coplanar_degrees)
    regions = _regions_of(vertices, faces, face, edges, settings)
    turn, ends = regions.turn, regions.ends
    decided = (regions.area >= settings.least_share * regions.area.sum()) & (turn >= settings.least_turn)
    is_polygonal = regions.is_strip | (regions.several >= 0.5)
    is_cut = decided & (regions.several >= 0.5) & (regions.mixed >= settings.mixed)
    ambiguous = decided & ~is_cut & (is_polygonal | ends) & (turn >= settings.doubtful_turn)
    is_faceted = is_cut | (ambiguous & is_polygonal & ends & (turn >= settings.faceted_turn))
    if is_faceted.any():  # a body that has facets has facets on all sides
        is_faceted |= (turn >= settings.least_turn) & is_polygonal & ends
    number = np.where(is_faceted[regions.number] & regions.is_large, np.arange(len(regions.number)), -1)[face]
    if not ambiguous.any():
        return Facets(number, "")
    worst = np.where(ambiguous, regions.area, 0).argmax()
    return Facets(
        number,
        f"{(regions.number == worst).sum()} flat faces that meet at about {turn[worst]:.0f} degrees may be facets or "
        f"samples of a smooth surface, and are traced as {'flat' if is_faceted[worst] else 'smooth'}",
    )


class _Regions(NamedTuple):
    """Regions of flat faces that are connected by edges below the crease angle.

    Attributes:
        number: region of each flat face.
        is_large: whether each flat face is no part of a rounded edge.
        area: area of each region.
        several: share of the area of large faces that belongs to faces of several triangles.
        mixed: share of the edges between large faces, by length, at which neither two triangles nor two quadrilaterals
            meet.
        turn, is_strip: mean angle between neighbouring faces, and whether they form a strip or ring, see `_turn`.
        ends: whether each region ends at sharp edges.
    """

    number: Int[np.ndarray, " flat"]
    is_large: Bool[np.ndarray, " flat"]
    area: Float[np.ndarray, " regions"]
    several: Float[np.ndarray, " regions"]
    mixed: Float[np.ndarray, " regions"]
    turn: Float[np.ndarray, " regions"]
    is_strip: Bool[np.ndarray, " regions"]
    ends: Bool[np.ndarray, " regions"]


def _regions_of(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "F 3"], face: Int[np.ndarray, "F"],
    edges: _Edges, settings: FacetSettings,
) -> _Regions:  # fmt: skip
    """Connect flat faces to regions, and measure the regions; `face` is the flat face of each triangle."""
    from trimesh.graph import connected_component_labels

    area = np.bincount(face, 0.5 * np.linalg.norm(area_vectors(vertices[faces]), axis=1))
    corners = _num_corners(faces, face)
    between = edges.subset(face[edges.first] != face[edges.second])
    between = between._replace(first=face[between.first], second=face[between.second])
    crease = settings.crease_degrees
    sharp, soft = (between.subset(is_sharp) for is_sharp in (between.angle >= crease, between.angle < crease))
    region = connected_component_labels(np.stack([soft.first, soft.second], 1), len(area))
    region = np.unique(region, return_inverse=True)[1].reshape(-1)
    count = region.max() + 1
    is_large = area >= settings.small * _typical(region, area)[region]
    of_large = np.bincount(region, area * is_large, count)
    several = np.bincount(region, area * is_large * (np.bincount(face) > 1), count) / of_large
    soft = soft.subset(is_large[soft.first] & is_large[soft.second])
    of_region = region[soft.first]
    length = np.maximum(np.bincount(of_region, soft.length, count), np.finfo(float).tiny)
    alike = (corners[soft.first] == corners[soft.second]) & (corners[soft.first] <= 4)
    mixed = np.bincount(of_region, soft.length * ~alike, count) / length
    rim = sum(np.bincount(region[side], sharp.length, count) for side in (sharp.first, sharp.second))
    ends = rim >= settings.open * length
    return _Regions(region, is_large, np.bincount(region, area), several, mixed, *_turn(soft, region, length), ends)


def _edges(vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "F 3"]) -> _Edges:
    start, end = faces.reshape(-1), np.roll(faces, -1, 1).reshape(-1)
    key = np.minimum(start, end) * (faces.max() + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    first = first[np.diff(first, append=len(key)) == 2]
    one, other = order[first] // 3, order[first + 1] // 3
    normals = area_vectors(vertices[faces])
    sine = np.linalg.norm(np.cross(normals[one], normals[other]), axis=1)
    angle = np.degrees(np.arctan2(sine, (normals[one] * normals[other]).sum(1)))
    return _Edges(one, other, angle, np.linalg.norm(vertices[end] - vertices[start], axis=1)[order[first]])


def _flat_faces(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "F 3"], edges: _Edges, degrees: float
) -> Int[np.ndarray, "F"]:
    """Number the sets of connected triangles that lie in one plane up to `degrees`."""
    from trimesh.graph import connected_component_labels

    flat = edges.angle < degrees
    label = connected_component_labels(np.stack([edges.first[flat], edges.second[flat]], 1), len(faces))
    normals = area_vectors(vertices[faces])
    sums = np.stack([np.bincount(label, column) for column in normals.T], -1)[label]
    tilt = np.degrees(np.arctan2(np.linalg.norm(np.cross(normals, sums), axis=1), (normals * sums).sum(1)))
    # Triangles of a finely tessellated surface are coplanar with their neighbours, but not with one plane.
    is_bent = np.bincount(label, tilt > 3 * degrees)[label] > 0
    label = np.where(is_bent, label.max() + 1 + np.arange(len(label)), label)
    return np.unique(label, return_inverse=True)[1].reshape(-1)


def _num_corners(faces: Int[np.ndarray, "F 3"], face: Int[np.ndarray, "F"]) -> Int[np.ndarray, " flat"]:
    """Count the corners of flat faces: vertices at which at least three flat faces meet."""
    pairs = np.unique(faces.reshape(-1) * (face.max() + 1) + np.repeat(face, 3))
    vertex, flat = np.divmod(pairs, face.max() + 1)
    return np.bincount(flat, np.bincount(vertex)[vertex] >= 3).astype(np.int64)


def _typical(region: Int[np.ndarray, " flat"], area: Float[np.ndarray, " flat"]) -> Float[np.ndarray, " regions"]:
    """Return the area of the flat face at the middle of the area of each region."""
    order = np.lexsort((area, region))
    total = np.bincount(region, area)
    middle = np.searchsorted(np.cumsum(area[order]), np.cumsum(total) - 0.5 * total)
    return np.asarray(area[order[middle.clip(max=len(order) - 1)]])


def _turn(
    soft: _Edges, region: Int[np.ndarray, " flat"], length: Float[np.ndarray, " regions"]
) -> tuple[Float[np.ndarray, " regions"], Bool[np.ndarray, " regions"]]:
    """Return the mean angle between neighbouring faces in each region, and whether the faces form a strip or ring."""
    turn = np.bincount(region[soft.first], soft.length * soft.angle, len(length)) / length
    ends = np.sort(np.stack([soft.first, soft.second], 1), 1)
    pairs = np.unique(ends, axis=0)
    num_neighbours = np.bincount(pairs.reshape(-1), minlength=len(region))
    num_pairs, num_faces = np.bincount(region[pairs[:, 0]], minlength=len(length)), np.bincount(region)
    is_strip = (num_pairs > 0) & (np.bincount(region, num_neighbours > 2) == 0)
    # On a cone, faces meet at smaller angles than the sides of its base.
    return np.where(is_strip & (num_pairs == num_faces), 360 / num_faces, turn), is_strip
