"""Edge maps as a learned detector would give them: soft lines at exact sub-pixel positions, and what goes wrong."""

from dataclasses import dataclass

import cv2
import numpy as np

SIGMA_PER_FWHM = 1.0 / (2.0 * np.sqrt(2.0 * np.log(2.0)))
REACH = 3.5  # standard deviations: beyond, a line is darker than half a grey level
SPECKLE_LENGTH_PX = 3.0  # mean length of a false dash


@dataclass(frozen=True)
class Imperfections:
    """How the drawn edge maps differ from the truth. The defaults resemble a good learned detector.

    width_px:      full width at half maximum across a drawn edge.
    blur_px:       standard deviation of a further blur of the whole map; it dims thin lines, as detectors do.
    gap_fraction:  expected fraction of the visible length that is missing, anew in each view.
    gap_length_px: mean length of a gap.
    jitter_px:     standard deviation of the shift of a whole edge across each image axis, anew in each view.
    speckle:       false dashes for each 10,000 pixels.
    noise:         standard deviation of grey noise, as a fraction of full scale.
    contours:      draw the occluding contours of smooth surfaces too, which are no edges.
    """

    width_px: float = 2.3
    blur_px: float = 0.4
    gap_fraction: float = 0.04
    gap_length_px: float = 10.0
    jitter_px: float = 0.15
    speckle: float = 0.5
    noise: float = 0.015
    contours: bool = True

    @staticmethod
    def none() -> "Imperfections":
        """Clean maps: the visible sharp edges, all of them and nothing else."""
        return Imperfections(blur_px=0.0, gap_fraction=0.0, jitter_px=0.0, speckle=0.0, noise=0.0, contours=False)


def draw_edge_map(
    pixels: np.ndarray,
    chains: np.ndarray,
    strokes: np.ndarray,
    visible: np.ndarray,
    image_size: int,
    imperfections: Imperfections,
    generator: np.random.Generator,
) -> np.ndarray:
    """One edge map.

    pixels: (n, 2) samples, less than a pixel apart along a chain. chains, strokes: (n,) int, see `LineSamples`.
    visible: (n,) bool. Returns (image_size, image_size) uint8.
    """
    shifts = generator.normal(0.0, imperfections.jitter_px, (strokes.max(initial=0) + 1, 2))
    pixels = pixels + shifts[strokes]
    joined = (chains[1:] == chains[:-1]) & visible[1:] & visible[:-1]
    starts, ends = pixels[:-1][joined], pixels[1:][joined]
    kept = ~in_gap(starts, ends, strokes[1:][joined], imperfections, generator)
    dashes = false_dashes(image_size, imperfections, generator)
    starts, ends = np.concatenate([starts[kept], dashes[:, 0]]), np.concatenate([ends[kept], dashes[:, 1]])
    sigma = imperfections.width_px * SIGMA_PER_FWHM
    return finish(gaussian_lines(starts, ends, image_size, sigma), imperfections, generator)


def in_gap(
    starts: np.ndarray,
    ends: np.ndarray,
    strokes: np.ndarray,
    imperfections: Imperfections,
    generator: np.random.Generator,
) -> np.ndarray:
    """(s,) bool: which of the (s, 2) consecutive segments fall into a randomly placed gap of their stroke."""
    lengths, middles = np.linalg.norm(ends - starts, axis=1), (starts + ends) / 2.0
    missing = np.zeros(len(starts), bool)
    # The last gap goes beyond what is asked for; asking for up to one gap less makes it right on average.
    wanted = imperfections.gap_fraction * lengths.sum() - generator.uniform() * imperfections.gap_length_px
    while lengths[missing].sum() < wanted:
        middle = generator.choice(len(starts), p=lengths / lengths.sum())
        radius = 0.5 * imperfections.gap_length_px * generator.uniform(0.5, 1.5)
        near = np.linalg.norm(middles - middles[middle], axis=1) < radius
        missing |= near & (strokes == strokes[middle])
    return missing


def false_dashes(image_size: int, imperfections: Imperfections, generator: np.random.Generator) -> np.ndarray:
    """(d, 2, 2) end points of short lines where there is no edge."""
    count = generator.poisson(imperfections.speckle * image_size**2 / 1e4)
    middles = generator.uniform(0.0, image_size - 1.0, (count, 2))
    angles = generator.uniform(0.0, np.pi, count)
    halves = 0.5 * generator.exponential(SPECKLE_LENGTH_PX, count)
    reach = halves[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    # Cut into short pieces, because `gaussian_lines` looks only at the surroundings of each segment's middle.
    fractions = np.linspace(-1.0, 1.0, 13)[:, None, None]
    chain = middles + fractions * reach
    return np.stack([chain[:-1], chain[1:]], axis=2).reshape(-1, 2, 2)


def gaussian_lines(starts: np.ndarray, ends: np.ndarray, image_size: int, sigma: float) -> np.ndarray:
    """(H, W) in 0..1: exp(-d^2 / 2 sigma^2) of the distance d to the nearest of the (s, 2) short segments.

    The nearest one alone counts, so that lines are no brighter where they cross or where a chain has its joints.
    """
    half = int(np.ceil(REACH * sigma)) + 1
    offsets = np.stack(np.meshgrid(np.arange(-half, half + 1), np.arange(-half, half + 1)), axis=-1).reshape(-1, 2)
    # (s, k) arrays, of which a pair is five times as fast as one (s, k, 2) array.
    columns, rows = np.rint((starts + ends) / 2.0).astype(np.int64).T[:, :, None] + offsets.T[:, None]
    along_x, along_y = (ends - starts).T[:, :, None]
    away_x, away_y = columns - starts[:, :1], rows - starts[:, 1:]
    fraction = (away_x * along_x + away_y * along_y) / np.maximum(along_x**2 + along_y**2, 1e-12)
    fraction = np.clip(fraction, 0.0, 1.0)
    squared = (away_x - fraction * along_x) ** 2 + (away_y - fraction * along_y) ** 2
    inside = (columns >= 0) & (columns < image_size) & (rows >= 0) & (rows < image_size)
    field = np.full(image_size * image_size, np.inf)
    np.minimum.at(field, (columns + image_size * rows)[inside], squared[inside])
    return np.exp(-field / (2.0 * sigma**2)).reshape(image_size, image_size)


def finish(lines: np.ndarray, imperfections: Imperfections, generator: np.random.Generator) -> np.ndarray:
    """Blur and noise; (H, W) in 0..1 -> uint8."""
    if imperfections.blur_px > 0:
        lines = cv2.GaussianBlur(lines, (0, 0), imperfections.blur_px)
    lines = lines + generator.normal(0.0, imperfections.noise, lines.shape)
    return np.rint(np.clip(lines, 0.0, 1.0) * 255.0).astype(np.uint8)
