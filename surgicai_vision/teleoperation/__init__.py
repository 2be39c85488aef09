"""Teleoperation: a person drives the active arm; successful episodes are kept as demonstrations.

    keys, sticks ──poll──► Input ──InputMapping──► action (7,) ──Session.tick──► env ──► Recordings
       web page ◄───────────────── images and status ◄──────────────┘

The parts, each usable and tested alone:

* `inputs`: what a person can command at one moment (`Input`: three translations, three rotations,
  the jaw, fine or not, events) and the protocol `Device`. `input_map`: the env's action for it,
  in the axes of a camera or of the tool.
* `keyboard`, `gamepad`: presses and releases, axes and buttons → `Input`. The key table that
  `--help`, the page and the documentation show is in `keyboard`. Keys are named as browsers name
  them (`KeyboardEvent.code`): by their place on the keyboard, whatever is printed on them.
* `session`: the state machine waiting → driving → judged → kept or discarded. Stepped by `tick`,
  one control step of 20 ms each. It has no clock, no thread and no randomness except the episode's
  seed: the same inputs give the same files.
* `recordings`: the folder. An episode is written whole as soon as it is kept, so a process killed
  at any moment loses only the attempt under way. The same command then continues the numbers and
  the seeds.
* `core.pacer`, `loop`: ticks at 50 Hz of the wall clock. When rendering is too slow, images are
  dropped, never ticks.
* `web`: the page on which a person sees and acts; a `Device` and a `Screen` (`loop`).

The page's server listens on loopback only, its address holds a random token, and a gamepad on the
viewer's own machine works through the browser. Images are polled one by one, not streamed, so a
slow connection shows fewer of them and none late.
"""
