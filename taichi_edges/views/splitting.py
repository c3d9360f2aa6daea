"""Which views are held out of everything but the evaluation."""

from collections.abc import Sequence
from dataclasses import replace

from taichi_edges.errors import UserError, did_you_mean
from taichi_edges.views.views import Views

FEWEST_VIEWS, SHARE, MOST = 8, 10, 3  # auto: from so many views on, one in ten of them, at most three
LEAST_LEFT = 3  # views to find edges in: the viewing planes of two always meet


def choose_held_out(names: Sequence[str], wanted: str | int | list[str] | tuple[str, ...]) -> list[int]:
    """Indices of the views to hold out, ascending. wanted: 'auto', 'off', a number, or a tuple of names.

    Those that `auto` and a number choose are in the middles of equal stretches of all views; the first and the last
    stay, at the ends of a path of cameras.
    """
    if isinstance(wanted, (tuple, list)):
        for name in wanted:
            if name not in names:
                raise UserError(f"evaluation.held_out: there is no view '{name}'{did_you_mean(name, list(names))}")
        chosen = {list(names).index(name) for name in wanted}
    else:
        count = {"off": 0, "auto": _automatic(len(names))}[wanted] if isinstance(wanted, str) else wanted
        middles = ((2 * number + 1) * len(names) // (2 * count) for number in range(count))
        chosen = {min(max(middle, 1), len(names) - 2) for middle in middles}
    left = len(names) - len(chosen)
    if chosen and (left < LEAST_LEFT or left < len(chosen)):
        problem = f"{len(chosen)} of {len(names)} views leave too few to find edges in"
        raise UserError(f"evaluation.held_out: {problem}; hold out at most half of them, and leave {LEAST_LEFT}")
    return sorted(chosen)


def _automatic(count: int) -> int:
    """How many of so many views `auto` holds out."""
    return min((count + SHARE // 2) // SHARE, MOST) if count >= FEWEST_VIEWS else 0


def split_views(views: Views, held_out: Sequence[int]) -> tuple[Views, Views]:
    """Views without those at the indices `held_out`, and Views of those alone."""
    rest = [view for view in range(len(views)) if view not in set(held_out)]
    return _some_views(views, rest), _some_views(views, held_out)


def _some_views(views: Views, chosen: Sequence[int]) -> Views:
    edgels = views.edgels
    return replace(
        views,
        names=tuple(views.names[view] for view in chosen),
        image_paths=tuple(views.image_paths[view] for view in chosen),
        edge_maps=views.edge_maps[chosen],
        intrinsics=views.intrinsics[chosen],
        world_to_camera=views.world_to_camera[chosen],
        edgels=None if edgels is None else edgels.of_some(chosen),
    )
