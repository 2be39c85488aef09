"""Many demonstrations from a few: a demonstration's pieces, re-posed to another start."""
