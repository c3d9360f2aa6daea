"""Exit 1 unless a run's metrics lie within bounds: check_metrics.py RUN_FOLDER KEY:[LOWEST]:[HIGHEST] ..."""

import json
import sys
from pathlib import Path


def main(folder, *bounds):
    """Print one line for each bound; returns the number of violated ones."""
    metrics = json.loads((Path(folder) / "metrics.json").read_text())
    violated = 0
    for bound in bounds:
        key, lowest, highest = bound.split(":")
        value = metrics[key]
        inside = (
            value is not None and (not lowest or value >= float(lowest)) and (not highest or value <= float(highest))
        )
        violated += not inside
        print(f"{Path(folder).name}: {key} = {value} {'within' if inside else 'OUTSIDE'} [{lowest}, {highest}]")
    return violated


if __name__ == "__main__":
    sys.exit(1 if main(*sys.argv[1:]) else 0)
