"""Reinforcement and offline learning, by Stable-Baselines3 and d3rlpy (extra `rl`).

It stands above evaluation: what is trained is evaluated by `evaluation.rollout`, and what comes out
is a checkpoint like any other, of the policy `actor`, `bcq`, `hlp` or `residual`. `algorithms`,
`settings`, `extra`, `transitions`, `export` and the `*_config` modules import no library of the
extra; `train` imports the others once it knows the algorithm.

Interface:

* `algorithms.ALGORITHMS`: name → what it is: its library, whether it needs demonstrations, whether
  it relabels goals. Light to import.
* `settings.Settings`: frozen settings of all of them, with what each paper says.
* `transitions.of_demos(paths, config, obs_type) -> Transitions`: demonstrations replayed in an env:
  observation, action executed, reward, next observation, terminated, truncated.
* `export.write(transitions, format, out)`: npz, d3rlpy, Minari, SB3's replay and HER buffers;
  `export.fill(buffer, transitions)` puts them into a buffer of a model of one's own.
* `vec_env.SuturingVecEnv(task, n_envs, workers=…)`: our envs as Stable-Baselines3's `VecEnv`.
* `extractor.RelativeExtractor`: the relative features of a goal dict as SB3's features extractor.
* `train.train(request, demos, out) -> Checkpoint`: train, or go on where it was broken off.
* `high_level.train_high_level(request, out)`: PPO as high-level policy over fixed low-level ones.
* `residual.train_residual(request, out)`: a correction of a frozen image policy.

Layout of the folder while it trains; the first and the last three stay:

    training.json          what was asked for; marks the folder as ours
    training_state.pt      weights, optimisers, replay buffer, envs and random state
    curve.json             successes on validation starts against env steps, updates and minutes
    policy.safetensors     weights and the statistics of the inputs
    checkpoint.json        everything about them, with their hash; written last
"""

import contextlib

with contextlib.suppress(ImportError):
    # gym, which d3rlpy brings and Stable-Baselines3 imports, prints a notice about itself.
    from gym_notices import notices

    notices.notices.clear()
