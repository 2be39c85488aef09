"""Reinforcement and offline learning, with Stable-Baselines3 and d3rlpy (extra `rl`).

This package depends on evaluation: `evaluation.rollout` evaluates what is trained. The result is a
checkpoint like any other, of the policy `actor`, `bcq`, `hlp` or `residual`. `algorithms`,
`settings`, `extra`, `transitions`, `export` and the `*_config` modules import no library of the
extra; `train` imports the others once it knows the algorithm.

Interface:

* `algorithms.ALGORITHMS`: name → algorithm: its library, whether it needs demonstrations, whether
  it relabels goals. Light to import.
* `settings.Settings`: frozen settings of all algorithms, with the values of the papers.
* `transitions.of_demos(paths, config, obs_type) -> Transitions`: demonstrations replayed in an env:
  observation, action executed, reward, next observation, terminated, truncated.
* `export.write(transitions, format, out)`: npz, d3rlpy, Minari, SB3's replay and HER buffers;
  `export.fill(buffer, transitions)` adds them to the replay buffer of your own model.
* `vec_env.SuturingVecEnv(task, n_envs, workers=…)`: our envs as Stable-Baselines3's `VecEnv`.
* `extractor.RelativeExtractor`: the relative features of a goal dict as SB3's features extractor.
* `train.train(request, demos, out) -> Checkpoint`: train, or resume an interrupted training.
* `high_level.train_high_level(request, out)`: PPO as high-level policy over fixed low-level ones.
* `residual.train_residual(request, out)`: a correction of a frozen image policy.

Layout of the folder during training; the first and the last three files stay:

    training.json          the request; marks the folder as ours
    training_state.pt      weights, optimisers, replay buffer, envs and random state
    curve.json             successes on validation starts against env steps, updates and minutes
    policy.safetensors     weights and the statistics of the inputs
    checkpoint.json        everything about them, with their hash; written last
"""

import contextlib

with contextlib.suppress(ImportError):
    # gym, which d3rlpy installs and Stable-Baselines3 imports, prints a notice about itself.
    from gym_notices import notices

    notices.notices.clear()
