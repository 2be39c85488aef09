"""Encoders: the plug-in family to extend with new ways of seeing, one file per member.

A member is an `encoders.base.Plugin` (a card and a loader) plus one line in
`surgicai_vision.features.encoders`.
"""
