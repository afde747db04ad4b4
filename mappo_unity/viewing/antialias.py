"""Smooth edges in finished pictures, on the processor.

Where there is no graphics card, OpenGL's own
way (four samples a pixel) costs more than the rest of the picture; this looks at the pixels at edges only.

The method is FXAA (T. Lottes, "FXAA", NVIDIA 2009): a stair step of an edge is found by walking along the
edge to both its ends, and each of its pixels is mixed with the one across the edge by its place on the step.
"""

from __future__ import annotations

import numpy as np

CONTRAST = 40  # of 1020: neighbours that differ by more are an edge
REACH = (1, 2, 3, 4, 6, 8, 12)  # pixels walked along an edge
SOFTEN = 0.75  # the largest part of its neighbour that a lone pixel, as on a thin line, takes


def smooth_edges(frame: np.ndarray) -> None:
    """Smooth the edges of a picture uint8 [height, width, 3] in place; the outermost pixels stay."""
    wide = frame.astype(np.int16)
    luma = wide[..., 0] + 2 * wide[..., 1] + wide[..., 2]  # 0 to 1020
    pixel = _pixels_at_edges(luma)
    if not pixel.size:
        return

    around = _Neighbours(luma, pixel)
    part = np.maximum(_part_by_place(luma.reshape(-1), pixel, around), _part_of_lone_pixels(around))

    colors = frame.reshape(-1, 3)
    own, other = colors[pixel].astype(np.float32), colors[pixel + around.across]
    colors[pixel] = (own + (other - own) * part[:, None] + 0.5).astype(np.uint8)


class _Neighbours:
    """Brightness around pixels [K], and which way the edge runs there."""

    def __init__(self, luma: np.ndarray, pixel: np.ndarray) -> None:
        width = luma.shape[1]
        at = luma.reshape(-1).take
        up, down = pixel - width, pixel + width

        self.own = at(pixel)
        north, south, west, east = (at(place) for place in (up, down, pixel - 1, pixel + 1))
        corners = (at(up - 1), at(up + 1), at(down - 1), at(down + 1))
        self.cross = (north, south, west, east)
        self.mean = (2 * (north + south + west + east) + sum(corners)) / np.float32(12)

        # An edge that runs level changes brightness from row to row: compare second differences.
        nw, ne, sw, se = corners
        level = (
            np.abs(nw + sw - 2 * west) + 2 * np.abs(north + south - 2 * self.own) + np.abs(ne + se - 2 * east)
        )
        steep = (
            np.abs(nw + ne - 2 * north) + 2 * np.abs(west + east - 2 * self.own) + np.abs(sw + se - 2 * south)
        )
        is_level = level >= steep

        # The edge lies on the side with the larger step of brightness.
        before, after = np.where(is_level, north, west), np.where(is_level, south, east)
        is_before = np.abs(before - self.own) >= np.abs(after - self.own)
        self.other = np.where(is_before, before, after)
        side = np.where(is_level, width, 1)
        self.across = np.where(is_before, -side, side)  # steps in the flat picture: over the edge
        self.along = np.where(is_level, 1, width)


def _pixels_at_edges(luma: np.ndarray) -> np.ndarray:
    """Return the places in the flat picture [K] where a neighbour differs in brightness."""
    edge = np.zeros(luma.shape, bool)
    sideways = np.abs(luma[:, 1:] - luma[:, :-1]) > CONTRAST
    downwards = np.abs(luma[1:] - luma[:-1]) > CONTRAST

    # Both pixels of a pair that differs are at the edge.
    edge[:, 1:] = sideways
    edge[:, :-1] |= sideways
    edge[1:] |= downwards
    edge[:-1] |= downwards

    # The outermost pixels have no neighbours on all sides to be compared with.
    edge[[0, -1]] = edge[:, [0, -1]] = False

    return np.flatnonzero(edge)


def _part_by_place(luma: np.ndarray, pixel: np.ndarray, around: _Neighbours) -> np.ndarray:
    """Return which part of the pixel across the edge each pixel takes, 0 to 0.5, by its place on its step."""
    pair = around.own + around.other  # twice the brightness of the edge
    limit = np.abs(around.other - around.own) // 2
    ends = [_walk(luma, pixel, sign * around.along, around.across, pair, limit) for sign in (-1, 1)]
    (back, back_change), (ahead, ahead_change) = ends
    near, change = np.minimum(back, ahead), np.where(back < ahead, back_change, ahead_change)

    # Only one side of an edge gives way: where the edge bends at its near end towards this pixel.
    gives_way = (2 * around.own < pair) != (change < 0)
    return np.where(gives_way, 0.5 - near / (back + ahead), 0).astype(np.float32)


def _walk(
    luma: np.ndarray,
    pixel: np.ndarray,
    step: np.ndarray,
    across: np.ndarray,
    pair: np.ndarray,
    limit: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Walk along the edge until its brightness changes; return the pixels walked and the change there."""
    walked = np.full(pixel.size, REACH[-1], np.float32)
    change = np.zeros(pixel.size, np.int16)
    going = np.arange(pixel.size)

    # All pixels walk at once; those that have reached the end of their step drop out.
    for distance in REACH:
        at = pixel[going] + distance * step[going]
        found = luma.take(at, mode="clip") + luma.take(at + across[going], mode="clip") - pair[going]
        change[going] = found

        ended = np.abs(found) >= limit[going]
        walked[going[ended]] = distance
        going = going[~ended]
        if not going.size:
            break

    return walked, change


def _part_of_lone_pixels(around: _Neighbours) -> np.ndarray:
    """Return which part of its neighbour a pixel takes because it stands out from all around it."""
    lowest = np.minimum.reduce([around.own, *around.cross])
    range_ = np.maximum.reduce([around.own, *around.cross]) - lowest
    out = np.minimum(np.abs(around.mean - around.own) / np.maximum(range_, 1), 1)
    return (((3 - 2 * out) * out * out) ** 2 * SOFTEN).astype(np.float32)
