"""roboarm benchmark: entries of policies, functions and programs; replays; hostile entries."""

import hashlib
import sys

import h5py
import numpy as np
import pytest
import yaml
from paths import ROOT
from problem_files import write_folder

from roboarm_nmp.datasets.problems import load_problems, write_problems
from roboarm_nmp.evaluation import benchmark
from roboarm_nmp.evaluation.entrants import EntrantError, FunctionMethod, ProgramMethod
from roboarm_nmp.evaluation.evaluate import EvaluationError, evaluate
from roboarm_nmp.evaluation.submissions import SubmissionError, read_actions, verify_submission
from roboarm_nmp.viewer import show

EXAMPLES = ROOT / "examples" / "benchmark"
TASKS = ["double_walls", "chased_goals"]


@pytest.fixture(scope="module")
def entry(tmp_path_factory):
    """A submission of go-to-goal, four queries of two tasks."""
    folder = tmp_path_factory.mktemp("benchmark") / "entry"
    flags = ["--policy", "go-to-goal", "--num-queries", "4", "--workers", "1"]
    assert benchmark.main(["run", *flags, "--tasks", *TASKS, "--output", str(folder)]) == 0
    return folder


@pytest.fixture
def copy(entry, tmp_path):
    """A copy of it, to be changed."""
    for path in entry.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


def change(folder, name, edit):
    with h5py.File(folder / "double_walls.h5", "a") as file:
        array = file[name][:]
        del file[name]
        file[name] = edit(array)


def test_entry_is_verified_and_its_numbers_are_those_of_an_evaluation(entry, tmp_path, capsys):
    rows = tmp_path / "rows"
    rows.mkdir()
    command = ["verify", str(entry), "--workers", "1", "--row", str(rows / "row.yaml")]
    assert benchmark.main(command) == 0
    assert "8 episodes replayed, all as claimed" in capsys.readouterr().out
    row = yaml.safe_load((rows / "row.yaml").read_text())
    expected = evaluate("go-to-goal", "double_walls", num_queries=4)
    for name in ("success_rate", "collision_free_success_rate", "success_rate_interval"):
        assert row["tasks"]["double_walls"][name] == expected[name]
    # Rounded actions make slightly other motions where the arm slides along a wall.
    length = row["tasks"]["double_walls"]["path_length"]
    assert length == pytest.approx(expected["path_length"], rel=0.02)
    assert benchmark.main(["table", str(rows)]) == 0
    table = capsys.readouterr().out
    assert "### `chased_goals`\n" in table and "| go-to-goal | " in table
    assert f"| 4, `{row['tasks']['double_walls']['queries_digest'][:8]}` |" in table


def test_example_entries_are_rows_of_the_leaderboard(capsys):
    for folder in (EXAMPLES / "entries").iterdir():
        row = yaml.safe_load((ROOT / f"benchmarks/leaderboard/{folder.name}.yaml").read_text())
        claim = yaml.safe_load((folder / "submission.yaml").read_text())
        for task, of_task in claim["tasks"].items():
            digest = hashlib.sha256((folder / f"{task}.h5").read_bytes()).hexdigest()
            assert digest == of_task["sha256"] == row["tasks"][task]["sha256"]
    assert benchmark.main(["verify", str(EXAMPLES / "entries/td3"), "--workers", "1"]) == 0
    assert "100 episodes replayed, all as claimed" in capsys.readouterr().out


def test_episode_of_an_entry_is_shown(entry, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("roboarm_nmp.viewer.images.MAX_FRAMES", 4)
    steps = len(read_actions(entry, "chased_goals").of_query(3))
    flags = ["--entry", str(entry), "--query", "3", "--size", "64", "48"]
    assert show.main(["chased_goals", *flags, "--output", str(tmp_path / "a.gif")]) == 0
    assert f"query 3: {steps} steps" in capsys.readouterr().out


def test_goal_poses_are_judged_by_the_criterion_of_motion_policy_networks(tmp_path, capsys):
    flags = ["--policy", "planner", "--pose-goals", "--num-queries", "4", "--workers", "1"]
    entry = str(tmp_path / "entry")
    assert benchmark.main(["run", *flags, "--tasks", "double_walls", "--output", entry]) == 0
    row = tmp_path / "row.yaml"
    assert benchmark.main(["verify", entry, "--workers", "1", "--row", str(row)]) == 0
    strict = yaml.safe_load(row.read_text())["tasks"]["double_walls"]["mean_steps"]
    rough = evaluate("planner", "double_walls", goal_type="pose", num_queries=4)
    assert 0 <= strict - rough["mean_steps"] <= 2  # it ends nearer to the goal
    capsys.readouterr()
    assert benchmark.main(["table", str(tmp_path)]) == 0
    table = capsys.readouterr().out
    assert "### `double_walls`, goals are poses" in table and "Networks' criterion |" in table


def test_sets_of_problems_are_entered_from_their_files(tmp_path, capsys):
    imported = tmp_path / "box_panda.h5"
    write_problems(imported, load_problems(write_folder(tmp_path / "box_panda")))
    entry, problems = str(tmp_path / "entry"), ["--problems", str(tmp_path), "--workers", "1"]
    run = ["run", "--policy", "planner", "--tasks", "box_panda", "--output", entry]
    assert benchmark.main(run) == 1
    assert "box_panda: needs MotionBenchMaker's problems" in capsys.readouterr().err
    assert benchmark.main([*run, *problems]) == 0
    assert benchmark.main(["verify", entry, *problems]) == 0
    output = capsys.readouterr().out
    assert "success 1.000, collision-free 1.000" in output and "1 episodes replayed" in output


def test_policies_flags_change_the_class_of_an_entry(capsys):
    def described(*flags):
        options = benchmark._parser().parse_args(["run", "--output", "entry", *flags])
        return benchmark._method(options)[2:]

    filtered = ["--policy", "go-to-goal", "--safety-margin", "0.01"]
    assert described("--policy", "go-to-goal") == ("nothing", False, False)
    assert described(*filtered) == ("ground truth", False, True)
    assert described(*filtered, "--observes", "point_cloud") == ("point cloud", False, False)


def test_interrupted_run_continues_and_another_method_is_refused(entry, capsys):
    before = (entry / "double_walls.h5").stat().st_mtime_ns
    run = ["run", "--tasks", *TASKS, "--num-queries", "4", "--workers", "1"]
    run += ["--output", str(entry), "--policy"]
    assert benchmark.main([*run, "go-to-goal"]) == 0
    assert (entry / "double_walls.h5").stat().st_mtime_ns == before
    assert benchmark.main([*run, "random"]) == 1
    assert (
        "begun otherwise, use another --output: method is 'go-to-goal'" in capsys.readouterr().err
    )
    assert benchmark.main([*run, "go-to-goal", "--observes", "point_cloud"]) == 1
    assert benchmark.main([*run, "go-to-goal", "--num-queries", "7"]) == 1
    assert "double_walls.h5 has 4 queries, not 7: delete it" in capsys.readouterr().err


def test_smallest_change_of_an_action_is_found_and_its_query_named(copy):
    first = read_actions(copy, "double_walls").offsets[3]

    def nudge(actions):
        actions.view(np.uint32)[first, 2] ^= 1 << 8
        return actions

    change(copy, "actions", nudge)
    with pytest.raises(SubmissionError, match="double_walls.h5: query 3: "):
        verify_submission(copy)


@pytest.mark.parametrize(
    "name, edit, message",
    [
        ("success", lambda x: 1 - x, r"query 0: success is (True|False), not"),
        ("actions", lambda x: x * np.float32(np.nan), "some actions are not finite"),
        ("actions", lambda x: x.astype(np.float64), "type float64"),
        ("digests", lambda x: x[:3], "different lengths"),
        ("seconds", lambda x: np.zeros((10**5,), np.float32), "seconds has shape"),
    ],
)
def test_hostile_files_give_one_error(copy, name, edit, message):
    change(copy, name, edit)
    with pytest.raises(SubmissionError, match=message):
        verify_submission(copy)


def test_claims_that_do_not_hold_and_bad_descriptions_are_refused(copy):
    path = copy / "submission.yaml"
    document = yaml.safe_load(path.read_text())
    for edit, message in (
        (lambda tasks: tasks["chased_goals"].update(path_length=1.0), "path_length is .* as claim"),
        (lambda tasks: tasks.update(nowhere={}), "no such task: nowhere"),
        (lambda tasks: tasks["double_walls"].update(success_rate="1"), "must have the numbers"),
    ):
        changed = yaml.safe_load(path.read_text())
        edit(changed["tasks"])
        path.write_text(yaml.safe_dump(changed))
        with pytest.raises(SubmissionError, match=message):
            verify_submission(copy)
        path.write_text(yaml.safe_dump(document))
    path.write_text("[" * 5_000)
    with pytest.raises(SubmissionError, match=r"submission\.yaml"):
        verify_submission(copy)


def test_function_observes_points_and_its_motion_is_free_more_often(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    method = FunctionMethod("potential_field:begin", "point_cloud")
    field = evaluate(method, "random_boxes_hard", num_queries=4)
    straight = evaluate("go-to-goal", "random_boxes_hard", num_queries=4)
    assert field["collision_rate"] < straight["collision_rate"]


START = [0, 0, 0, -1, 0, 1, 0]


def path(waypoints):
    return f"print('{{\"path\": {waypoints}}}')"


def test_program_follows_its_path():
    method = ProgramMethod(f"{sys.executable} {EXAMPLES / 'straight_line.py'}")
    result = evaluate(method, "double_walls", num_queries=3)
    straight = evaluate("go-to-goal", "double_walls", num_queries=3)
    assert result["success_rate"] == straight["success_rate"]


@pytest.mark.parametrize(
    "answer, message",
    [
        ("print('{}' if 'start' in line else '{\"action\": [0]}')", "action: must be 7 finite"),
        ("print('{\"action\": [0]}')", "its answer to a problem has action, must have `path`"),
        ("print('{}\\n{}')", "it printed more than one line for a question: '{}'"),
        ("print('{\"path\": [[0, 0, 0, 0, 0, 0, NaN]]}')", "path: must have 2 to 10,000 waypoints"),
        (path(f"[{START}, [0, 0]]"), "waypoint 1: must be 7 finite numbers"),
        (path(f"[{START}, [90, 0, 0, -1, 0, 1, 0]]"), "waypoint 1 is outside .* joint 1 at 90 rad"),
        ("sys.exit(3)", r"ended without an answer \(exit code 3\)"),
    ],
)
def test_program_with_a_bad_answer_gives_one_error(tmp_path, answer, message):
    lines = ["import sys", "for line in sys.stdin:", f"    {answer}", "    sys.stdout.flush()"]
    (tmp_path / "bad.py").write_text("\n".join(lines))
    with pytest.raises((EntrantError, EvaluationError), match=message):
        evaluate(ProgramMethod(f"{sys.executable} {tmp_path / 'bad.py'}"), "wall", num_queries=1)


def test_function_or_program_that_does_not_exist_is_refused():
    with pytest.raises(EntrantError, match="expected MODULE:FUNCTION"):
        FunctionMethod("nowhere:begin")
    with pytest.raises(EvaluationError, match="cannot be started"):
        evaluate(ProgramMethod("./nowhere"), "wall", num_queries=1)
