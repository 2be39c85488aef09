"""Core: what every stage stands on: names, configuration, errors, files, processes."""
