"""The command line, `taichi-edges`. Nothing is imported here that takes long: --help and mistakes answer at once."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import taichi_edges
from taichi_edges.corridor.stages import STAGES
from taichi_edges.errors import OptionError, UserError


class OneLineParser(argparse.ArgumentParser):
    """Says what is wrong with the command line in one line, without the usage before it."""

    def error(self, message: str) -> NoReturn:
        """Exit with status 2."""
        self.exit(2, f"error: {message}; see {self.prog} --help\n")


def make_parser() -> OneLineParser:
    """The parser of the command line. It repeats names from tables that take long to import."""
    parser = OneLineParser(
        prog="python -m taichi_edges" if Path(sys.argv[0]).name == "__main__.py" else None,
        description=f"Recover the 3D edges of a scene: {', '.join(STAGES)}.",
        epilog="A stage that is up to date is skipped, so the same command resumes an interrupted run.",
    )
    parser.add_argument(
        "scene", help="scene file; name of a scene that comes along, e.g. demo; folder: COLMAP, nerfstudio, photos, ..."
    )
    parser.add_argument("--stage", choices=STAGES, help="start with this stage, from the artefacts on disk")
    parser.add_argument("--until", choices=STAGES, help="stop after this stage")
    parser.add_argument("--data", metavar="FOLDER", help="data root for relative paths (default: TAICHI_EDGES_DATA)")
    parser.add_argument("--out", metavar="FOLDER", default="runs", help="results go to FOLDER/<scene> (default: runs)")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="e.g. --set train.epochs=100")
    parser.add_argument("--preset", choices=("fast", "paper"), help="training schedule (default: the scene's, or fast)")
    parser.add_argument("--scale", choices=("part", "object", "building", "room"), help="settings for such a scene")
    parser.add_argument("--seed", type=int, help="seed of every random choice (default: the scene's)")
    parser.add_argument("--threads", type=int, help="CPU threads (default: all this process may use)")
    parser.add_argument("--arch", choices=("cpu", "cuda", "vulkan"), default="cpu", help="where the kernels run")
    parser.add_argument("--show", action="store_true", help="at the end, show points and edges in a window")
    parser.add_argument("--quiet", action="store_true", help="no progress, only warnings and the final summary")
    parser.add_argument("--version", action="version", version=f"taichi-edges {taichi_edges.__version__}")
    return parser


def parse_arguments(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The options of the command line; None for that of this process."""
    return make_parser().parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line. Returns the exit status: 0, or 2 for a mistake the user can put right."""
    options = parse_arguments(arguments)
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")  # for paths with letters that its encoding lacks
    try:
        from taichi_edges.corridor.command import run_command

        run_command(options)
        sys.stdout.flush()
    except UserError as error:
        print(f"error: {'--' if isinstance(error, OptionError) else ''}{error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of the summary has closed it, as `| head` does; all artefacts are written
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        print("interrupted; the same command resumes with the stage it was in", file=sys.stderr)
        return 130
    return 0
