"""Dynamic movement primitives: fitted to demonstrations, executed from new starts."""
