"""Policies: the plug-in family to extend with new ways of acting, one file per member.

A member is a `policies.base.Plugin` (a recipe type and a policy type) plus one line in
`surgicai_vision.training.policies`.
"""
