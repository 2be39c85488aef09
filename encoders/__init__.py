"""Encoders: the family you extend to see differently, one file a member.

A member is an `encoders.base.Plugin` (a card and a loader) and one line in
`surgicai_vision.features.encoders`.
"""
