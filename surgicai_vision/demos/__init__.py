"""Demonstrations: recorded as states, rendered later.

`store` is the format, `demonstrator` defines what may demonstrate, `rollout` runs one episode and
`record` many, `imports` replays recordings of other systems, `dmp` has movement primitives.
"""
