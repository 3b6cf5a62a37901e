"""The folder of a study: one study only, parts that are whole or computed anew."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dopslam_ros.lab.study.folder import DamagedPart, open_folder, part_path, read_part, write_part
from dopslam_ros.lab.study.plan import Plan, StudyError, Task
from dopslam_ros.lab.study.results import Collection, Results, load_results
from dopslam_ros.lab.study.run import FIELDS, Part
from dopslam_ros.simulation.scenario import Scenario

TASK = Task("dead_reckoning:gamma=3", 0.1, 2)


@pytest.fixture
def plan(short: Scenario) -> Plan:
    return Plan(short, ("dead_reckoning", "genie"), (0.1, None), 3, 9)


def fill(plan: Plan, folder: Path, results: Results, leave_out: tuple[Task, ...] = ()) -> None:
    """A folder with parts, as a study leaves it."""
    open_folder(folder, plan)
    for task in plan.tasks():
        if task not in leave_out:
            table = results.tables[task.filter, task.doppler][task.run]
            write_part(folder, task, Part(table, np.ones(len(table))))


def test_a_part_comes_back_as_it_was(tmp_path: Path) -> None:
    table = np.random.default_rng(1).standard_normal((5, len(FIELDS)))
    table[2, 10] = np.nan
    assert read_part(tmp_path, TASK, 5) is None
    write_part(tmp_path, TASK, Part(table, np.arange(5.0)))
    part = read_part(tmp_path, TASK, 5)
    assert part is not None
    assert part.table.tobytes() == table.tobytes() and part.seconds.tolist() == [0, 1, 2, 3, 4]
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["run00002.npz"]


def test_every_task_has_a_file_of_its_own(short: Scenario) -> None:
    labels = ("joint", "joint:gamma=3", "joint:gamma=3,prune_type=0.01", "marginal")
    plan = Plan(short, labels, (0.1, 0.1000000001, None), 2, 1)
    paths = {part_path(Path("x"), task) for task in plan.tasks()}
    assert len(paths) == len(list(plan.tasks())) == 24
    assert all(path.parts[:2] == ("x", "parts") and len(path.parts) == 5 for path in paths)


def test_damage_is_noticed_wherever_it_is(tmp_path: Path) -> None:
    """Cut off anywhere, or a bit turned over in anything that is read."""
    table = np.random.default_rng(1).standard_normal((2, len(FIELDS)))
    write_part(tmp_path, TASK, Part(table, np.arange(2.0)))
    path = part_path(tmp_path, TASK)
    whole = path.read_bytes()
    for length in range(0, len(whole), 37):
        path.write_bytes(whole[:length])
        with pytest.raises(DamagedPart, match=path.name):
            read_part(tmp_path, TASK, 2)
    noticed = 0
    for place in range(0, len(whole), 7):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x10]) + whole[place + 1 :])
        try:
            part = read_part(tmp_path, TASK, 2)
        except DamagedPart:
            noticed += 1
        else:  # dates and the like: what counts is whole
            assert part is not None
            assert part.table.tobytes() == table.tobytes()
            assert part.seconds.tolist() == [0.0, 1.0]
    assert noticed > len(whole) / 7 / 2


@pytest.mark.parametrize(
    "arrays",
    [
        {"table": np.zeros((3, len(FIELDS))), "seconds": np.zeros(3)},
        {"table": np.zeros((2, 4)), "seconds": np.zeros(2)},
        {"table": np.zeros((2, len(FIELDS)))},
        {"table": np.array([object()]), "seconds": np.zeros(2)},
    ],
    ids=["steps", "fields", "half", "objects"],
)
def test_a_part_of_something_else_is_damage(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    path = part_path(tmp_path, TASK)
    path.parent.mkdir(parents=True)
    np.savez(path, **arrays)
    with pytest.raises(DamagedPart, match=path.name):
        read_part(tmp_path, TASK, 2)


def test_a_folder_goes_on_with_its_study_only(tmp_path: Path, plan: Plan) -> None:
    folder = tmp_path / "a" / "b"
    open_folder(folder, plan)
    before = (folder / "plan.json").read_bytes()
    # It may grow, and shrink.
    open_folder(folder, replace(plan, filters=("joint",), dopplers=(0.3, 0.1), runs=7))
    assert (folder / "plan.json").read_bytes() != before
    open_folder(folder, plan)
    assert (folder / "plan.json").read_bytes() == before
    for change, words in (
        ({"seed": 8}, "seed is 8, there 9"),
        ({"settings": {"gamma": 3}}, "settings.gamma is 3, there None"),
        (
            {"scenario": replace(plan.scenario, detection_probability=0.8)},
            "scenario.detection_probability is 0.8, there 0.9",
        ),
        (
            {"scenario": replace(plan.scenario, controls=plan.scenario.controls[:3])},
            r"scenario.controls is \[{'steps': 3,.*there \[{'steps': 8,",
        ),
    ):
        with pytest.raises(StudyError, match=f"another study: {words}"):
            open_folder(folder, replace(plan, **change))
    assert (folder / "plan.json").read_bytes() == before


def test_a_study_of_another_version_is_another(tmp_path: Path, plan: Plan) -> None:
    open_folder(tmp_path, plan)
    content = json.loads((tmp_path / "plan.json").read_text())
    content["software"]["numpy"] = "1.26.0"
    (tmp_path / "plan.json").write_text(json.dumps(content))
    with pytest.raises(StudyError, match=r"software.numpy is .*, there 1\.26\.0"):
        open_folder(tmp_path, plan)


def test_a_folder_of_something_else_stays_as_it_is(tmp_path: Path, plan: Plan) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(StudyError, match="holds no study: give another --out"):
        open_folder(tmp_path, plan)
    (tmp_path / "plan.json").write_text("{")
    with pytest.raises(StudyError, match=r"plan\.json' cannot be read"):
        open_folder(tmp_path, plan)
    (tmp_path / "plan.json").write_text("[1]")
    with pytest.raises(StudyError, match=r"plan\.json' is not the plan"):
        open_folder(tmp_path, plan)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plan.json", "thesis.tex"]


def test_results_are_loaded(tmp_path: Path, plan: Plan, do: Callable[[Plan], Results]) -> None:
    results = do(plan)
    fill(plan, tmp_path, results)
    loaded = load_results(tmp_path)
    assert loaded.plan.filters == plan.filters and loaded.plan.scenario.steps == 8
    assert list(loaded.run_numbers) == [0, 1, 2]
    assert list(loaded.tables) == list(results.tables)
    for case, table in results.tables.items():
        assert loaded.tables[case].tobytes() == table.tobytes()
    peb = loaded.field("genie", None, "peb")
    assert peb.shape == (3, 8)
    np.testing.assert_array_equal(peb, results.tables["genie", None][:, :, 7])
    # Results made by hand hold all runs of the plan.
    assert list(Results(plan, results.tables).run_numbers) == [0, 1, 2]


def test_only_runs_that_all_have_done_are_compared(
    tmp_path: Path, plan: Plan, do: Callable[[Plan], Results]
) -> None:
    results = do(plan)
    fill(plan, tmp_path, results, leave_out=(Task("genie", None, 1),))
    loaded = load_results(tmp_path)
    assert list(loaded.run_numbers) == [0, 2]
    for case, table in results.tables.items():
        assert loaded.tables[case].tobytes() == table[[0, 2]].tobytes()


def test_a_damaged_part_is_told_and_to_be_done_again(
    tmp_path: Path, plan: Plan, do: Callable[[Plan], Results]
) -> None:
    fill(plan, tmp_path, do(plan))
    path = part_path(tmp_path, Task("genie", 0.1, 2))
    path.write_bytes(path.read_bytes()[:-100])
    collection = Collection(plan, tmp_path)
    assert collection.missing() == [Task("genie", 0.1, 2)]
    assert len(collection.damaged) == 1 and str(path) in collection.damaged[0]
    with pytest.raises(StudyError, match="do the study again"):
        load_results(tmp_path)


def test_folders_without_results(tmp_path: Path, plan: Plan) -> None:
    with pytest.raises(StudyError, match=r"holds no study: it has no plan\.json"):
        load_results(tmp_path)
    open_folder(tmp_path, plan)
    with pytest.raises(StudyError, match="no run of the study is done by every filter yet"):
        load_results(tmp_path)
