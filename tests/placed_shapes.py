"""Random shapes, and figures of a frame of their own, put anywhere in the unit cube: along no axis of the world's."""

import numpy as np

from taichi_edges.geometry.shapes import EllipticArc, Line, Spline

PLANE = np.array([[1.0, 0, 0], [0, 1.0, 0]])
KINDS = ("line", "arc", "long_arc", "circle", "elliptic_arc", "long_elliptic_arc", "ellipse", "spline", "loop")


class Placing:
    """A similarity, drawn at random: points (n, 3) of a figure near its origin -> (n, 3) in the unit cube."""

    def __init__(self, generator, scale=None):
        rotation = np.linalg.qr(generator.normal(size=(3, 3)))[0]
        self.rotation = rotation * np.sign(np.linalg.det(rotation))
        self.scale = scale or generator.uniform(0.5, 2.0)
        self.middle = 0.5 + generator.uniform(-0.05, 0.05, 3)

    def __call__(self, points):
        points = self.scale * np.asarray(points, dtype=np.float64)
        return (points[:, None] * self.rotation).sum(axis=2) + self.middle  # equal points stay equal, unlike those of @


def any_shape(kind, generator):
    """A random shape of a kind, anywhere in the unit cube."""
    place = Placing(generator)
    radius, low = generator.uniform(0.05, 0.2), generator.uniform(-4, 4)
    angle = generator.uniform(0.3, 3.0) if not kind.startswith("long") else generator.uniform(3.3, 6.0)
    if kind == "line":
        return Line(place([[0.0, 0, 0], [generator.uniform(0.1, 0.3), 0, 0]]))
    if kind in ("arc", "long_arc", "circle"):
        arc = EllipticArc(np.zeros(3), radius * PLANE, low, low + (2 * np.pi if kind == "circle" else angle))
        return arc.transformed(place)
    if "ellip" in kind:
        axes = radius * PLANE * [[1.0], [generator.uniform(0.2, 0.9)]]
        return EllipticArc(np.zeros(3), axes, low, low + (2 * np.pi if kind == "ellipse" else angle)).transformed(place)
    return Spline(place(smooth_chain(kind == "loop", generator).reshape(-1, 3)).reshape(-1, 4, 3), kind == "loop")


def smooth_chain(closed, generator, count=4):
    """(count, 4, 3) cubics with a continuous tangent through random points of a wave, or of a wavy round (Catmull)."""
    place = np.arange(-1, count + 2)
    turn = 2 * np.pi * (place % count) / count
    round = np.stack([np.cos(turn), np.sin(turn), generator.uniform(-0.3, 0.3, count)[place % count]])
    wave = np.stack([np.pi * place / count, *generator.uniform(-0.4, 0.4, (2, count + 3))])
    knots = generator.uniform(0.05, 0.1) * (round if closed else wave).T
    starts, ends, slopes = knots[1:-2], knots[2:-1], (knots[2:] - knots[:-2]) / 6
    return np.stack([starts, starts + slopes[:-1], ends - slopes[1:], ends], axis=1)
