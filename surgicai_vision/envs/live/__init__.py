"""Live: an env that a person watches while it runs.

* `browser`: a page with images, curves and, where somebody plays, the buttons of a player.
* `views`: what is drawn for it: any cameras, and a free one.
* `window`: MuJoCo's own viewer, where a display exists.
* `human`: `render_mode="human"`: the window, or the page where there is no display.
"""
