"""Multiplied demonstrations: how pieces are re-posed, and that they work from other starts."""

import dataclasses

import numpy as np
import pytest

from surgicai_vision import envs
from surgicai_vision.commands import record_demos
from surgicai_vision.commands.console import Console
from surgicai_vision.core import names
from surgicai_vision.core.config import WORLD, TaskConfig
from surgicai_vision.core.errors import InputError, UnknownName
from surgicai_vision.core.executor import RunContext
from surgicai_vision.demos.demonstrator import make_demonstrator
from surgicai_vision.demos.imports.surgicai import import_demos
from surgicai_vision.demos.multiply import cuts, segments
from surgicai_vision.demos.multiply.multiplier import Multiplier
from surgicai_vision.demos.record import record
from surgicai_vision.demos.rollout import Disturbance, rollout
from surgicai_vision.demos.stitch_path import turns_along
from surgicai_vision.demos.store import read_demo, read_marker, write_demo, write_marker
from surgicai_vision.envs import poses
from surgicai_vision.envs.geometry import Stitch
from surgicai_vision.envs.placement import Placement
from surgicai_vision.scene.holes import PAIRS
from surgicai_vision.scene.rotations import rpy_to_matrix


def demonstrate(folder, task, demonstrator="expert", count=2):
    """Write the first successes into a folder of demonstrations and return their files."""
    env = envs.make(TaskConfig(task))
    paths = []
    seed = 0
    while len(paths) < count:
        result = rollout(env, make_demonstrator(demonstrator, env), seed, demonstrator)
        if result.success:
            paths.append(write_demo(folder, len(paths), result.demo))
        seed += 1
    write_marker(folder, task, demonstrator)
    return paths


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """Two of the expert's demonstrations per subtask: {task: paths}."""
    folder = tmp_path_factory.mktemp("sources")
    paths = {}
    for task in names.SUBTASKS:
        (folder / task).mkdir()
        paths[task] = demonstrate(folder / task, task)
    return paths


def moved(moment, placement):
    """Return a moment with the phantom and everything on it moved."""
    pose = placement.T_world_phantom
    stitch = moment.stitch
    pair = placement.placed_pair(stitch.pair)
    return dataclasses.replace(
        moment,
        needle=pose @ moment.needle,
        tip=pose @ moment.tip,
        stitch=Stitch.of(pair, stitch.radius, stitch.tip_angle),
    )


def track_of(path, task):
    demo = read_demo(path)
    return cuts._track(envs.make(demo.config), demo, task, 0, len(demo), False)


@pytest.mark.parametrize("task", names.SUBTASKS)
def test_at_its_own_start_a_piece_is_what_was_commanded(sources, task):
    track = track_of(sources[task][0], task)
    for segment in cuts.read_source(str(sources[task][0])).segments[task]:
        moment = track.at(int(segment.step[0]))
        path = segment.reposed(moment)
        told = track.command if segment.body is None else track.carried @ segment.body(moment)
        own = segment.step < len(track.jaw)  # the closing of the jaws may be appended
        np.testing.assert_allclose(path[own], told[segment.step[own]], atol=1e-6)


@pytest.mark.parametrize("task", names.SUBTASKS)
def test_a_moved_phantom_moves_every_piece_rigidly(sources, task):
    where = Placement(0, 0.0, (0.004, -0.006), 0.2)
    source = cuts.read_source(str(sources[task][0]))
    for segment in source.segments[task]:
        here, there = source.start, moved(source.start, where)
        np.testing.assert_allclose(
            segment.reposed(there), where.T_world_phantom @ segment.reposed(here), atol=1e-9
        )


def test_a_longer_needle_keeps_its_shares_of_the_way(sources):
    """A half circle has further to turn; each ends where its own insertion ends."""
    source = cuts.read_source(str(sources["insert"][0]))
    tissue = source.segments["insert"][-1]
    own = source.start.stitch
    half_circle = Stitch.of(PAIRS["simple"][0], own.radius, np.pi)
    long = dataclasses.replace(source.start, stitch=half_circle)
    ideal = dataclasses.replace(tissue, off=np.broadcast_to(np.eye(4), tissue.off.shape))
    shares = [
        np.interp(
            turns_along(moment.stitch, ideal.reposed(moment)),
            segments.turn_knots(moment.stitch),
            np.arange(4.0),
        )
        for moment in (source.start, long)
    ]
    np.testing.assert_allclose(*shares, atol=1e-6)
    assert segments.turn_knots(half_circle)[-1] > segments.turn_knots(own)[-1] + 0.5


@pytest.mark.parametrize("task", names.SUBTASKS)
def test_two_demonstrations_serve_other_starts_by_real_actions(sources, task):
    env = envs.make(TaskConfig(task))
    results = [rollout(env, Multiplier(env, sources[task]), seed) for seed in (500, 501, 502)]
    assert [one.success for one in results] == [True] * 3
    for result in results:
        assert np.abs(result.demo.action).max() <= 1.0
        assert result.demo.source in {cuts.read_source(str(p)).digest for p in sources[task]}
        env.reset(seed=result.demo.seed)
        for action, state in zip(result.demo.action, result.demo.state[1:], strict=True):
            env.step(action)
            np.testing.assert_array_equal(env.get_state(), state)


def test_noise_is_executed_and_the_label_comes_back_to_the_path(sources):
    env = envs.make(TaskConfig("insert"))
    result = rollout(
        env, Multiplier(env, sources["insert"]), 500, disturbance=Disturbance(noise=0.3)
    )
    assert result.success
    assert not np.array_equal(result.demo.executed, result.demo.action)


def test_a_varied_world_is_met(sources):
    env = envs.make(TaskConfig("insert", randomisation=WORLD))
    results = [rollout(env, Multiplier(env, sources["insert"]), seed) for seed in range(500, 504)]
    assert sum(one.success for one in results) >= 2
    assert len({tuple(env.simulation.draws)}) == 1


def test_the_nearest_start_is_its_own_and_random_ones_are_drawn_from_the_seed(sources):
    env = envs.make(TaskConfig("grasp"))
    digests = [cuts.read_source(str(path)).digest for path in sources["grasp"]]
    for path, digest in zip(sources["grasp"], digests, strict=True):
        env.reset(seed=read_demo(path).seed)
        assert Multiplier(env, sources["grasp"], "nearest").source == digest
    drawn = []
    for seed in (*range(8), *range(8)):
        env.reset(seed=seed)
        drawn.append(Multiplier(env, sources["grasp"], "random").source)
    assert drawn[:8] == drawn[8:]
    assert set(drawn) == set(digests)


def test_a_source_is_read_once_and_again_when_its_file_was_replaced(sources, tmp_path):
    one, other = (path.read_bytes() for path in sources["place"])
    path = tmp_path / "episode_000000.safetensors"
    path.write_bytes(one)
    first = cuts.read_source(str(path))
    assert cuts.read_source(str(path)) is first
    path.write_bytes(other)
    again = cuts.read_source(str(path))
    assert again.digest == cuts.read_source(str(sources["place"][1])).digest != first.digest


def test_attempts_keep_their_times_and_go_on_after_success(tmp_path):
    (path,) = demonstrate(tmp_path, "grasp", "search", 1)
    env = envs.make(TaskConfig("grasp"))
    multiplier = Multiplier(env, [path])
    env.reset(seed=500)
    assert multiplier.persists
    result = rollout(env, Multiplier(env, [path]), 500)
    assert result.success and len(result.demo) == env.config.max_steps

    def openings(demo):
        closes = demo.action[60:, 6] == -1.0
        return 60 + np.flatnonzero(closes[:-1] & (demo.action[61:, 6] > 0.0))

    shown = openings(read_demo(path))
    assert len(shown) == 4
    assert np.abs(openings(result.demo) - shown).max() <= 3


def test_records_with_its_sources_named_whatever_the_choice(sources, tmp_path):
    config = TaskConfig("grasp")
    seed = read_demo(sources["grasp"][0]).seed
    how = {"demonstrator": "multiply", "demos": sources["grasp"], "context": RunContext(0)}
    kept = record(config, episodes=2, seed=seed, out=tmp_path / "one", **how)
    marker = read_marker(tmp_path / "one")
    assert marker["demonstrator"] == "multiply"
    demos = [read_demo(path) for path in kept]
    assert marker["sources"] == [demo.source for demo in demos]
    assert set(marker["sources"]) <= set(marker["request"]["demos"])
    assert not {demo.seed for demo in demos} & {read_demo(path).seed for path in sources["grasp"]}
    again = record(config, episodes=2, seed=seed, out=tmp_path / "two", **how)
    assert [path.read_bytes() for path in kept] == [path.read_bytes() for path in again]
    with pytest.raises(InputError, match="is itself a multiplied"):
        Multiplier(envs.make(config), kept)


def test_the_command_takes_all_demonstrations_or_as_many_as_said(sources, tmp_path):
    options = record_demos.Options(
        task="grasp",
        episodes=1,
        demonstrator="multiply",
        from_=sources["grasp"][0].parent,
        source="random",
        workers=1,
        out=tmp_path / "demos",
    )
    report = record_demos.run(options, console=Console())
    assert report["episodes"] == 1
    request = read_marker(tmp_path / "demos")["request"]
    assert (request["source"], len(request["demos"])) == ("random", 2)


def test_refuses_what_does_not_fit(sources, tmp_path):
    grasp = envs.make(TaskConfig("grasp"))
    with pytest.raises(InputError, match="shows insert; to multiply 'grasp' it must show grasp"):
        Multiplier(grasp, sources["insert"])
    with pytest.raises(InputError, match="at least one"):
        Multiplier(grasp, [])
    with pytest.raises(UnknownName, match="source"):
        Multiplier(grasp, sources["grasp"], "furthest")
    with pytest.raises(InputError, match="must show grasp, place, insert, handoff, pullout"):
        Multiplier(envs.make(TaskConfig("suture")), sources["grasp"])
    demo = dataclasses.replace(read_demo(sources["grasp"][0]), scene_hash="0" * 64)
    with pytest.raises(InputError, match="recorded in another scene"):
        Multiplier(grasp, [write_demo(tmp_path, 0, demo)])
    with pytest.raises(InputError, match="'expert' does not choose a demonstration"):
        record(TaskConfig("grasp"), episodes=1, out=tmp_path / "none", source="random")


@pytest.mark.parametrize(
    ("task", "name"),
    [
        ("grasp", "approach_v2"),
        ("place", "place_v1"),
        ("insert", "insert_v2"),
        ("handoff", "regrasp_v2"),
        ("pullout", "pullout_v2"),
    ],
)
def test_recordings_of_surgicai_are_multiplied(shared, tmp_path, task, name):
    made = import_demos(
        shared / "surgicai" / f"surgicai_{name}.npz", task=task, out=tmp_path / "demos"
    )
    env = envs.make(TaskConfig(task))
    results = [rollout(env, Multiplier(env, made.paths[:3]), seed) for seed in (500, 501)]
    assert all(result.success for result in results)


def test_needle_and_grasp_go_with_the_object(sources):
    """With the needle turned by 20°, the approach to the grasp turns by the same angle."""
    source = cuts.read_source(str(sources["grasp"][0]))
    (way,) = source.segments["grasp"]
    pose = np.eye(4)
    pose[:3, :3] = rpy_to_matrix(0.0, 0.0, np.radians(20.0))
    there = dataclasses.replace(source.start, needle=source.start.needle @ pose)
    one = poses.flat(np.linalg.inv(source.start.needle) @ way.reposed(source.start)[0])
    other = poses.flat(np.linalg.inv(there.needle) @ way.reposed(there)[0])
    np.testing.assert_allclose(one, other, atol=1e-9)


def test_a_number_of_demonstrations_without_their_folder_is_refused(tmp_path):
    options = record_demos.Options(demos_used=7, out=tmp_path / "demos")
    with pytest.raises(InputError, match="--demos-used is 7, but there is no --from"):
        record_demos.run(options, console=Console())
    assert not (tmp_path / "demos").exists()
