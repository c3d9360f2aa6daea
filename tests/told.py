"""A Progress for tests of what the user is told."""

from taichi_edges.progress import Progress


class Told(Progress):
    """Keeps what was said."""

    def __init__(self):
        self.notes, self.warnings = [], []

    def say(self, text):
        self.notes.append(text)

    def warn(self, text):
        self.warnings.append(text)
