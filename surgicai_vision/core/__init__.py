"""Core: what every stage builds on: names, configuration, errors, files, processes."""
