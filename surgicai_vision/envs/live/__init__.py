"""Live: an env that a person watches while it runs.

* `browser`: a page with images, curves and, where a player runs, playback buttons.
* `views`: the images drawn for it, from any cameras and a free one.
* `window`: MuJoCo's own viewer, if there is a display.
* `human`: `render_mode="human"`: the window, or the page if there is no display.
"""
