"""Web: pages for a browser on this machine only.

* `server`: a server on loopback behind a random token.
* `screen`: the newest images and status, passed from the working thread to the serving threads.
* `site`: a page about both, with `base.css` and `screen.js`, which all such pages load.
"""
