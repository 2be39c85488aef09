"""Policies: the family you extend to act differently, one file a member.

A member is a `policies.base.Plugin` (a recipe type and a policy type) and one line in
`surgicai_vision.training.policies`.
"""
