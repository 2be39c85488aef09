"""Web: pages that this machine's own browser opens, and nobody else.

* `server`: a server on loopback behind a random token.
* `screen`: the newest images and status, handed from the thread that works to those that serve.
* `site`: a page about both, with `base.css` and `screen.js`, which all such pages load.
"""
