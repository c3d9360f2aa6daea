"""From a scene to its files: the command, the pipeline, and a file for each stage."""
