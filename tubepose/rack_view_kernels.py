"""The loops over points of a rack's search and of what speaks for a pose, compiled; see `rack_kernels`."""

from __future__ import annotations

import math

import numpy as np

from tubepose.rack_kernels import compiled, in_frame


@compiled
def labelled(points_m, rotation, origin_m, camera_m, reach_m, window_m, through_m):
    """Points within `window_m` of a frame's plane (N, 3), and where sight to those far below crosses it (M, 2)."""
    solid, free = np.empty_like(points_m), np.empty((len(points_m), 2))
    solids, frees = 0, 0
    for k in range(len(points_m)):
        right, ahead, up = in_frame(points_m[k], rotation, origin_m)
        if not (abs(up) < window_m or up < -through_m):
            continue
        if up < -through_m:
            share = up / (up - camera_m[2])
            right += share * (camera_m[0] - right)
            ahead += share * (camera_m[1] - ahead)
        if abs(right) < reach_m[0] and abs(ahead) < reach_m[1]:
            if up < -through_m:
                free[frees, 0], free[frees, 1] = right, ahead
                frees += 1
            else:
                solid[solids, 0], solid[solids, 1], solid[solids, 2] = right, ahead, up
                solids += 1
    return solid[:solids].copy(), free[:frees].copy()


@compiled
def cells_crossed(points_m, step, rotation, origin_m, camera_m, side_m, shape):
    """Which cells of a rectangle about a frame's origin the lines of sight to every `step`-th point cross."""
    hit = np.zeros((shape[0], shape[1]), np.bool_)
    for k in range(0, len(points_m), step):
        right, ahead, up = in_frame(points_m[k], rotation, origin_m)
        share = up / (up - camera_m[2])
        u = (right + share * (camera_m[0] - right)) / side_m[0] + 0.5
        v = (ahead + share * (camera_m[1] - ahead)) / side_m[1] + 0.5
        if 0 <= u < 1 and 0 <= v < 1:
            hit[int(u * shape[0]), int(v * shape[1])] = True
    return hit


@compiled
def log_chances(xy_m, shift_m, low_m, cell_m, shape, table, sign, edge_m, blur_m, wrong):
    """Sum of log likelihoods that places (N, 2 or more) less a shift are solid (sign 1) or free (-1), and their number.

    Of those on the field's grid alone.
    """
    total, count = 0.0, 0
    for k in range(len(xy_m)):
        x, y = (xy_m[k, 0] - shift_m[0] - low_m[0]) / cell_m, (xy_m[k, 1] - shift_m[1] - low_m[1]) / cell_m
        if -0.5 <= x < shape[0] - 0.5 and -0.5 <= y < shape[1] - 0.5:
            i, j = math.floor(x + 0.5), math.floor(y + 0.5)
            cell = table[i * shape[1] + j]
            inside = sign * (edge_m - cell[0] - cell_m * ((x - i) * cell[1] + (y - j) * cell[2]))
            total += math.log(wrong + (1.0 - 2.0 * wrong) / (1.0 + math.exp(-inside / blur_m)))
            count += 1
    return total, count
