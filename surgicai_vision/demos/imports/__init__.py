"""Imports: recordings made elsewhere become demonstrations in this scene."""
