"""Training: from features and actions to a policy."""
