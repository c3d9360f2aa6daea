#!/usr/bin/env python
"""Parametric 3D edges from images: `python run.py scenes/demo.yaml` or `run.py my_photos/`. Argument parsing only."""

import argparse
import os
import sys

STAGES = ("prepare", "train", "cluster", "fit", "refine", "evaluate", "export")


class OneLineParser(argparse.ArgumentParser):
    """Says what is wrong with the command line in one line, without the usage before it."""

    def error(self, message):
        """Exit with status 2."""
        self.exit(2, f"error: {message}; see {self.prog} --help\n")


def parse_arguments(arguments=None):
    """The command line; kept free of heavy imports so that --help answers at once."""
    parser = OneLineParser(
        description=f"Recover the 3D edges of a scene: {', '.join(STAGES)}.",
        epilog="A stage that is up to date is skipped, so the same command resumes an interrupted run.",
    )
    parser.add_argument("scene", help="scene file, e.g. scenes/demo.yaml, or a folder: COLMAP, nerfstudio, photos, ...")
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
    return parser.parse_args(arguments)


def main(arguments=None):
    """Run from the command line. Returns the exit status: 0, or 2 for a mistake the user can put right."""
    options = parse_arguments(arguments)
    from taichi_edges.errors import UserError

    try:
        from taichi_edges.corridor.command import run_command

        run_command(options)
        sys.stdout.flush()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of the summary has closed it, as `| head` does; all artefacts are written
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        print("interrupted; the same command resumes with the stage it was in", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
