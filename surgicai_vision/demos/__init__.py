"""Demonstrations: recorded as states, rendered later.

`store` is the format, `record` rolls an expert, `importing` replays foreign recordings,
`safe_pickle` opens pickles without trusting them.
"""
