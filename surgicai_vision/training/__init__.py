"""Training: features and actions become a policy."""
