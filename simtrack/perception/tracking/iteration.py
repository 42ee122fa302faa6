"""One outer iteration of the registration, from a cast to moved poses, in a single compiled call.

A frame asks for some of them, and a detection of something new for dozens, of a few hundred rays each: in separate
calls a quarter of their time goes into what stands between the calls.
"""

import numpy as np
from numba import njit

from simtrack.perception.tracking.correspondences import (
    Edges,
    ModelImages,
    Points,
    draw,
    edge_correspondences,
    erase,
    mark_around,
    point_correspondences,
    rows_of,
)
from simtrack.perception.tracking.solver import SolverSettings, advance, gauss_newton, umeyama

NO_SILHOUETTES = -1
"""Instead of a reach: silhouettes are not looked for."""


@njit(cache=True, nogil=True)
def _rows(hit, instances, active, rows):
    """Row of the active instance that each ray hit, -1 = miss.

    Occluders that are not registered keep their rays, which are neither misses nor rows: they get the number of rows.
    """
    count, largest = instances.shape[0], -1
    for i in range(hit.shape[0]):
        largest = max(largest, hit[i])
    table = np.full(largest + 1, count, np.int32)
    for k in range(count):
        if active[k] and instances[k] <= largest:
            table[instances[k]] = k
    rows_of(hit, table, rows)


@njit(cache=True, nogil=True)
def iterate(
    pixels, directions, distances, normals, hit, depth, model_depth, model_instance, marks,
    measured, model, normal, weight, owner, edge_point, edge_direction, edge_offset, edge_weight, edge_owner,
    instances, active, strides, fine_strides, radii, camera, poses,
    counts, seen, used, covariance, constrained, stats, moved, deviations,
    fine, gate, front, model_sigma, focal_baseline, edge_reach, edge_step, correlation_area, edge_correlation,
    edges, kernel, edge_kernel, edge_sigma, unconstrained_sigma, max_shift, max_turn, last_step,
    iterations, closed_form,
):  # fmt: skip
    """Pair what rays met with what was measured, and move the active instances by solver steps on these pairs.

    Args:
        pixels: (N,) of the rays, as their `directions` (N, 3), z = 1.
        directions: camera frame.
        distances: (N,) of what the rays met, as `normals` (N, 3) and the instances that were `hit` (N,), -1 = none.
        normals: camera frame.
        hit: ids.
        depth: (H, W), measured, metres, 0 = no reading.
        model_depth: fields of `ModelImages`, with `model_instance`; untouched before and after.
        model_instance: see there.
        marks: see `mark_around`; in and out, unless this is a `fine` cast.
        measured: fields of `Points`, room for N; with `model`, `normal`, `weight`, `owner`.
        model: see there.
        normal: see there.
        weight: see there.
        owner: see there.
        edge_point: fields of `Edges`, room for N; with `edge_direction`, `edge_offset`, `edge_weight`, `edge_owner`.
        edge_direction: see there.
        edge_offset: see there.
        edge_weight: see there.
        edge_owner: see there.
        instances: (K,) ids of the rows.
        active: (K,), who is moved; the others only occlude.
        strides: (K,) pixel grids of this cast, and `fine_strides` of the finest one.
        fine_strides: (K,).
        radii: (K,), metres.
        camera: (4,) fx, fy, cx, cy.
        poses: (K, 4, 4) T_camera_object, in and out.
        counts: (K, FIELDS) rays by verdict, out, of the active rows as all that follows.
        seen: (K,) silhouette pixels, out.
        used: (K,) pixel grids that `counts` are of, out.
        covariance: (K, 6, 6), out, see `gauss_newton`, as for `constrained` (K,) and `stats` (K, 3).
        constrained: see there.
        stats: see there.
        moved: (K,), out, see `advance`, as for `deviations` (K,).
        deviations: see there.
        fine: whether this is the finest cast.
        gate: see `point_correspondences`, as for `front`, `model_sigma` and `focal_baseline`.
        front: see there.
        model_sigma: see there.
        focal_baseline: see there.
        edge_reach: pixels, see `edge_correspondences`, or `NO_SILHOUETTES`.
        edge_step: see there.
        correlation_area: pixels whose readings count as one, and `edge_correlation` silhouette pixels.
        edge_correlation: see there.
        edges: when silhouettes take part, and the following, see `SolverSettings`.
        kernel: see there.
        edge_kernel: see there.
        edge_sigma: see there.
        unconstrained_sigma: see there.
        max_shift: see there.
        max_turn: see there.
        last_step: see there.
        iterations: solver steps; 0: only judge the poses.
        closed_form: by Umeyama's fits instead of Gauss-Newton steps.

    """
    count, size = instances.shape[0], pixels.shape[0]
    rows = np.empty(size, np.int32)
    _rows(hit, instances, active, rows)
    if not fine:
        mark_around(pixels, rows, depth.shape[1], strides, fine_strides, marks)
    for k in range(count):
        if active[k]:
            counts[k], seen[k], used[k] = 0, 0, strides[k]
    points = Points(measured, model, normal, weight, owner)
    silhouette = Edges(edge_point, edge_direction, edge_offset, edge_weight, edge_owner)
    pairs = point_correspondences(
        pixels, directions, distances, normals, rows, depth.reshape(-1), depth.shape[1], strides, gate, front,
        0.0, model_sigma, focal_baseline, 0.4 / camera[0], np.zeros(3), points, 0, counts,
    )  # fmt: skip
    edge_pairs = 0
    if edge_reach != NO_SILHOUETTES:
        images = ModelImages(model_depth, model_instance)
        draw(pixels, distances, rows, images)
        edge_pairs = edge_correspondences(
            pixels, rows, depth, images, camera, strides, edge_reach, edge_step, focal_baseline, silhouette, seen
        )
        erase(pixels, images)
    centres, shifts = poses[:, :3, 3].copy(), np.zeros((count, 3))
    rotations, correlation = np.zeros((count, 3, 3)), np.empty((count, 2))
    for k in range(count):
        rotations[k, 0, 0] = rotations[k, 1, 1] = rotations[k, 2, 2] = 1.0
        correlation[k, 0] = max(1.0, correlation_area / strides[k] ** 2)
        correlation[k, 1] = max(1.0, edge_correlation / strides[k])
    steps = iterations
    if closed_form:
        umeyama(points, pairs, centres, rotations, shifts, iterations)
        steps = 0
    settings = SolverSettings(
        kernel, edge_kernel, edges, edge_sigma, unconstrained_sigma, max_shift, max_turn, last_step
    )
    gauss_newton(
        points, pairs, silhouette, edge_pairs, camera, centres, rotations, shifts, radii, correlation, active, settings,
        steps, covariance, constrained, stats,
    )  # fmt: skip
    if iterations:
        advance(poses, rotations, shifts, radii, covariance, active, moved, deviations)
