"""Demonstrations: recorded as states, rendered later.

`store` is the format, `demonstrator` says what may demonstrate, `rollout` runs one episode,
`record` many, `imports` replays recordings of other systems, `dmp` has movement primitives.
"""
