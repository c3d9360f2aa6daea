"""One object through which every stage reports: a bar with a time estimate on a terminal, plain lines elsewhere."""

import sys
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import TaskID

PLAIN_INTERVAL = 10.0  # seconds between two plain lines of the same task


class Progress:
    """What the stages are given. This base class is silent; `make_progress` makes those that report."""

    def say(self, text: str) -> None:
        """One line of information."""

    def warn(self, text: str) -> None:
        """One line that the user should not miss."""

    def track(self, title: str, total: int) -> "_Task":
        """A context manager whose value is called with the number of finished steps and a short note."""
        return _Task(self, title, total)

    def _update(self, task: "_Task", done: int, note: str) -> None:
        """Called at the start (done = 0) and whenever a task has got on."""

    def _finish(self, task: "_Task") -> None:
        """Called at the end of a task."""


class _Task:
    def __init__(self, progress: Progress, title: str, total: int) -> None:
        self.progress, self.title, self.total = progress, title, total
        self.handle: TaskID | None = None  # of its bar

    def __enter__(self) -> "_Task":
        self.started = self.reported = time.monotonic()
        self.progress._update(self, 0, "")
        return self

    def __call__(self, done: int, note: str = "") -> None:
        self.progress._update(self, done, note)

    def __exit__(self, *error: object) -> None:
        self.progress._finish(self)

    def remaining(self, done: int) -> float | None:
        """Seconds left, by the pace so far; None before there is one."""
        elapsed = time.monotonic() - self.started
        return elapsed * (self.total - done) / done if done else None


class PlainProgress(Progress):
    """Plain lines to standard error: for logs, pipes and `--quiet` (which keeps only the warnings)."""

    def __init__(self, quiet: bool = False) -> None:
        self.quiet = quiet

    def say(self, text: str) -> None:
        if not self.quiet:
            print(text, file=sys.stderr, flush=True)

    def warn(self, text: str) -> None:
        print(f"warning: {text}", file=sys.stderr, flush=True)

    def _update(self, task: _Task, done: int, note: str) -> None:
        now = time.monotonic()
        if self.quiet or done == 0 or (now - task.reported < PLAIN_INTERVAL):
            return
        task.reported = now
        left = task.remaining(done)
        self.say(
            f"  {task.title}: {100 * done / task.total:.0f} %, about {left:.0f} s left{f', {note}' if note else ''}"
        )


class TerminalProgress(PlainProgress):
    """Bars drawn by rich, with a time estimate."""

    def __init__(self) -> None:
        super().__init__()
        from rich.console import Console
        from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bars

        self.console = Console(stderr=True, highlight=False, emoji=False)
        columns = [TextColumn("  {task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn()]
        self.bars = Bars(*columns, TextColumn("{task.fields[note]}"), console=self.console, transient=True)

    def say(self, text: str) -> None:
        self.console.print(text, markup=False, soft_wrap=True)  # the terminal may wrap, but paths stay in one piece

    def warn(self, text: str) -> None:
        self.console.print(f"warning: {text}", style="yellow", markup=False, soft_wrap=True)

    def _update(self, task: _Task, done: int, note: str) -> None:
        if task.handle is None:
            self.bars.start()
            task.handle = self.bars.add_task(task.title, total=task.total, note="")
        self.bars.update(task.handle, completed=done, note=note)

    def _finish(self, task: _Task) -> None:
        if task.handle is not None:
            self.bars.remove_task(task.handle)
        if not self.bars.task_ids:
            self.bars.stop()


def make_progress(quiet: bool = False) -> Progress:
    """Bars on a terminal, plain lines elsewhere, warnings only with `quiet`."""
    return TerminalProgress() if sys.stderr.isatty() and not quiet else PlainProgress(quiet)
