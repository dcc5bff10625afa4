"""Compiled search for the first triangles on a line."""

from __future__ import annotations

import math

from nerfro.kernels.compilation import compiled
from nerfro.kernels.lookup import body_distance
from nerfro.samplers.paths.surface_search_cpu import advance

FARTHEST = 1e300  # beyond all triangles; boxes that are missed are at infinity
# Barycentric coordinates beyond which a line misses a triangle: lines through edges meet one of both triangles.
_TOLERANCE = 1e-9
# A ray skips triangles at its start, where it has just met them. Refraction towards the normal shortens the way between
# triangles that almost coincide, so this is a small share of the distance within which triangles are met together.
_SKIPPED = 1e-3


@compiled
def _inverse(rate):
    """Return the reciprocal, and a large number for zero, so that planes through the start are met at zero."""
    return 1.0 / rate if abs(rate) > 1e-300 else 1e300


@compiled
def _enter(box, x, y, z, qx, qy, qz):
    """Return the distance at which a line enters a box; infinite if it misses the box."""
    x0, x1 = (box[0, 0] - x) * qx, (box[1, 0] - x) * qx
    y0, y1 = (box[0, 1] - y) * qy, (box[1, 1] - y) * qy
    z0, z1 = (box[0, 2] - z) * qz, (box[1, 2] - z) * qz
    enter = max(min(x0, x1), max(min(y0, y1), min(z0, z1)))
    leave = min(max(x0, x1), min(max(y0, y1), max(z0, z1)))
    return enter if enter <= leave and leave >= 0.0 else math.inf


@compiled
def _meet(corners, line):
    """Intersect a line with the plane of a triangle.

    Returns:
        Distance; barycentric coordinates of the second and third corner; and a number that is negative if the line
        leaves through the front (Moeller and Trumbore 1997, "Fast, Minimum Storage Ray/Triangle Intersection").
    """
    ax, ay, az = corners[0, 0], corners[0, 1], corners[0, 2]
    ux, uy, uz = corners[1, 0] - ax, corners[1, 1] - ay, corners[1, 2] - az
    vx, vy, vz = corners[2, 0] - ax, corners[2, 1] - ay, corners[2, 2] - az
    x, y, z, dx, dy, dz = line
    px, py, pz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
    volume = ux * px + uy * py + uz * pz
    x, y, z = x - ax, y - ay, z - az
    qx, qy, qz = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux
    second, third = x * px + y * py + z * pz, dx * qx + dy * qy + dz * qz
    return (vx * qx + vy * qy + vz * qz) / volume, second / volume, third / volume, volume


@compiled
def _geometric_normal(corners):
    """Return the unit normal of a triangle by the right-hand rule."""
    ux, uy, uz = corners[1, 0] - corners[0, 0], corners[1, 1] - corners[0, 1], corners[1, 2] - corners[0, 2]
    vx, vy, vz = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1], corners[2, 2] - corners[0, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx / norm, ny / norm, nz / norm


@compiled
def _interpolated_normal(corners, normals, line):
    """Interpolate the normals at the corners of a triangle where it meets a line; returns a unit normal."""
    _, second, third, _ = _meet(corners, line)
    weights = min(max(1.0 - second - third, 0.0), 1.0), min(max(second, 0.0), 1.0), min(max(third, 0.0), 1.0)
    nx, ny, nz = 0.0, 0.0, 0.0
    for i in range(3):
        nx, ny, nz = nx + weights[i] * normals[i, 0], ny + weights[i] * normals[i, 1], nz + weights[i] * normals[i, 2]
    norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx / norm, ny / norm, nz / norm


@compiled
def face_normal(tree, face, line, ratio):
    """Return the unit normal that turns a line at a triangle.

    Normals at the corners are interpolated, unless reflected light would leave behind the triangle or refracted light
    before it; then the normal is that of the plane.

    Args:
        tree: triangles.
        face: the triangle.
        line: arriving line.
        ratio: ratio of the index before the triangle to the index behind it.
    """
    nx, ny, nz = _interpolated_normal(tree.corners[face], tree.normals[face], line)
    gx, gy, gz = _geometric_normal(tree.corners[face])
    cosine = line.dx * nx + line.dy * ny + line.dz * nz
    height, tilt = line.dx * gx + line.dy * gy + line.dz * gz, nx * gx + ny * gy + nz * gz
    mirrored_height = height - 2.0 * cosine * tilt
    root = math.sqrt(max(1.0 - ratio * ratio * (1.0 - cosine * cosine), 0.0))
    bent_height = ratio * height + (math.copysign(root, cosine) - ratio * cosine) * tilt
    if mirrored_height * height < 0.0 and (root == 0.0 or bent_height * height > 0.0):
        return nx, ny, nz
    return gx, gy, gz


@compiled
def _search_leaf(tree, scratch, leaf, line, nearest):
    """Update the first triangle of each layer by the triangles of a leaf; returns the smallest distance so far."""
    for i in range(tree.leaves.shape[1]):
        length, second, third, _ = _meet(tree.leaf_corners[leaf, i], line)
        if not (min(second, min(third, 1.0 - second - third)) >= -_TOLERANCE and length > _SKIPPED * tree.offset):
            continue
        face = tree.leaves[leaf, i]
        layer = tree.layer[face]
        if length < scratch.lengths[layer]:
            scratch.lengths[layer], scratch.faces[layer] = length, face
            nearest = min(nearest, length)
    return nearest


@compiled
def first_triangle(tree, scratch, line, limit):
    """Find the first triangle on a line, before a limit.

    After the call, `scratch.faces` has all triangles at the distance of the first one, because the ray continues behind
    them, at most one in each layer, and `scratch.crossings` has changed its sign for bodies whose surface is crossed.

    Returns:
        Body of the first triangle, -1 for none; the triangle; and the distances of the first and last triangle met.
    """
    nodes, entries = scratch.nodes, scratch.entries
    scratch.lengths[:] = math.inf
    x, y, z, dx, dy, dz = line
    qx, qy, qz = _inverse(dx), _inverse(dy), _inverse(dz)
    first_leaf, size, nearest = len(tree.leaves) - 1, 1, limit
    nodes[0], entries[0] = 0, _enter(tree.boxes[0], x, y, z, qx, qy, qz)
    while size > 0:
        size -= 1
        node = nodes[size]
        if entries[size] > nearest + tree.offset:
            continue
        if node >= first_leaf:
            nearest = _search_leaf(tree, scratch, node - first_leaf, line, nearest)
            continue
        left = 2 * node + 1
        near = _enter(tree.boxes[left], x, y, z, qx, qy, qz)
        far = _enter(tree.boxes[left + 1], x, y, z, qx, qy, qz)
        is_left = near <= far  # The nearer one is searched first.
        nodes[size], entries[size] = (left + 1, far) if is_left else (left, near)
        nodes[size + 1], entries[size + 1] = (left, near) if is_left else (left + 1, far)
        size += 2
    hit, first, farthest = -1, -1, nearest
    reach = nearest + tree.offset if nearest < limit else -1.0
    for layer in range(len(scratch.faces)):
        face = scratch.faces[layer] if scratch.lengths[layer] <= reach else -1
        scratch.faces[layer] = face
        if face >= 0:
            farthest = max(farthest, scratch.lengths[layer])
            body = tree.body[face]
            scratch.crossings[body] = -scratch.crossings[body]
            if hit < 0 and scratch.lengths[layer] == nearest:
                hit, first = body, face
    return hit, first, nearest, farthest


@compiled
def begin_inside(solids, tree, scratch, line):
    """Set which bodies contain the start of a line.

    Signed distances half-way to the first triangle determine the bodies. The smooth surface of the distances differs
    from the triangles. Therefore, if the distance to the body of the first triangle is less than a voxel, a ray begins
    inside this body if it leaves the body through the triangle.
    """
    hit, _, length, _ = first_triangle(tree, scratch, line, FARTHEST)
    half_way = advance(line, 0.5 * length if hit >= 0 else 0.0)
    for body in range(len(scratch.inside)):
        phi = body_distance(solids, body, half_way.x, half_way.y, half_way.z)
        spacings = solids.inverse_spacing[body]
        is_near = abs(phi) * min(spacings[0], min(spacings[1], spacings[2])) < 1.0
        decided, leaves = False, False
        for face in scratch.faces:
            if is_near and face >= 0 and tree.body[face] == body:
                _, _, _, volume = _meet(tree.corners[face], line)
                decided, leaves = True, leaves or volume < 0.0
        scratch.inside[body] = leaves if decided else hit >= 0 and phi < 0.0
