"""What is closed by default, and the policy file that says what each node may do."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import pytest

from dopslam_ros import topics
from dopslam_ros.bag import BagWriter
from dopslam_ros.nodes.bounds import BoundsNode
from dopslam_ros.nodes.filter import FilterNode
from dopslam_ros.nodes.player import PlayerNode
from dopslam_ros.nodes.recorder import RecorderNode
from dopslam_ros.nodes.simulator import SimulatorNode

if TYPE_CHECKING:
    from tests.conftest import Ros

pytestmark = pytest.mark.once
ROOT = Path(__file__).resolve().parents[2]
POLICY = ROOT / "config" / "sros2_policy.xml"
RULES = (("topics", "publish"), ("topics", "subscribe"), ("services", "reply"))
# Tells the range a node's process has come to, from within, where the middleware reads it.
TELL_RANGE = """
import os
import rclpy
rclpy.init = lambda **options: print(os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"])
from dopslam_ros.nodes import runtime
runtime._spin = lambda create: 0
runtime.run(None)
"""


def allowed(node: str, namespace: str) -> dict[str, set[str]]:
    """The full names in the policy by what is allowed, for a node in a namespace."""
    (profile,) = ElementTree.parse(POLICY).getroot().iterfind(f".//profile[@node='{node}']")
    prefix = namespace.rstrip("/") + "/"
    found: dict[str, set[str]] = {rule: set() for _, rule in RULES}
    for tag, rule in RULES:
        for item in profile.iterfind(f"{tag}[@{rule}='ALLOW']/*"):
            name = str(item.text).replace("~", node, 1)
            found[rule].add(name if name.startswith("/") else prefix + name)
    return found


def created(ros: Ros, node: str, namespace: str) -> dict[str, set[str]]:
    """What a running node has in the graph."""
    watcher = ros.node("watcher")
    look = {
        "publish": watcher.get_publisher_names_and_types_by_node,
        "subscribe": watcher.get_subscriber_names_and_types_by_node,
        "reply": watcher.get_service_names_and_types_by_node,
    }

    def names(rule: str) -> set[str]:
        return {name for name, _ in look[rule](node, namespace)}

    def known() -> bool:
        return (node, namespace) in watcher.get_node_names_and_namespaces()

    ros.spin_until(known)
    expected = allowed(node, namespace)
    ros.spin_until(lambda: all(len(names(rule)) >= len(expected[rule]) for rule in look))
    return {rule: names(rule) for rule in look}


@pytest.mark.parametrize("namespace", ["/", "/car1"])
@pytest.mark.parametrize("node", ["simulator", "filter", "bounds", "recorder", "player"])
def test_the_policy_is_what_the_nodes_do(
    ros: Ros, tmp_path: Path, scene: Path, node: str, namespace: str
) -> None:
    """No topic or service more, none less; /clock is heard only with simulated time."""
    bag = tmp_path / "played"
    with BagWriter(bag) as writer:
        for topic in (topics.FILTER_EVENTS, *topics.INPUTS, *topics.OUTPUTS):
            writer.add_topic(f"{namespace.rstrip('/')}/{topic.name}", topic.type_name)
    kind, parameters = {
        "simulator": (SimulatorNode, {"scenario": str(scene), "wait_for_nodes": "nobody"}),
        "filter": (FilterNode, {}),
        "bounds": (BoundsNode, {}),
        "recorder": (RecorderNode, {"bag": str(tmp_path / "bag")}),
        "player": (PlayerNode, {"bag": str(bag), "outputs": True, "wait_for_nodes": "nobody"}),
    }[node]
    ros.start(kind, namespace=namespace, use_sim_time=True, **parameters)
    assert created(ros, node, namespace) == allowed(node, namespace)


def test_the_policy_has_the_form_that_sros2_reads() -> None:
    """Policy, enclaves, enclave, profiles, profile, rules: nested as its schema says."""
    root = ElementTree.parse(POLICY).getroot()
    assert (root.tag, root.attrib) == ("policy", {"version": "0.2.0"})
    (enclaves,) = root
    for enclave in enclaves:
        assert (enclave.tag, set(enclave.attrib)) == ("enclave", {"path"})
        (profiles,) = enclave
        (profile,) = profiles
        assert (profiles.tag, profile.tag) == ("profiles", "profile")
        assert profile.attrib == {"ns": "/", "node": enclave.attrib["path"].rpartition("/")[2]}
        for rules in profile:
            ((rule, value),) = rules.attrib.items()
            assert (rules.tag, rule) in RULES and value == "ALLOW"
            assert {item.tag for item in rules} == {rules.tag.removesuffix("s")}


@pytest.mark.parametrize("chosen", [None, "SUBNET"])
def test_nodes_stay_on_this_machine_unless_told_otherwise(chosen: str | None) -> None:
    """Discovery is local where nothing is said, and what is said holds."""
    environment = {k: v for k, v in os.environ.items() if k != "ROS_AUTOMATIC_DISCOVERY_RANGE"}
    if chosen is not None:
        environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = chosen
    done = subprocess.run(
        [sys.executable, "-c", TELL_RANGE],
        env=environment,
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == [chosen or "LOCALHOST"]


def test_nothing_that_is_read_can_run_code() -> None:
    """YAML comes through the safe loader; nothing unpickles, evaluates or calls a shell."""
    forbidden = {"eval", "exec", "yaml.load", "yaml.unsafe_load", "yaml.full_load", "os.system"}
    # Serialisers are composed of the types that are installed, never of those in a bag.
    composed = ROOT / "dopslam_ros" / "bag" / "cdr.py"
    unsafe_modules = {"pickle", "marshal", "shelve", "dill"}
    for file in sorted((ROOT / "dopslam_ros").rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.Call):
                name = ast.unparse(node.func)
                allowed_here = file == composed and name == "exec"
                assert allowed_here or name not in forbidden, f"{file}:{node.lineno}"
                given = {k.arg: ast.unparse(k.value) for k in node.keywords}
                assert given.get("allow_pickle", "False") == "False", f"{file}:{node.lineno}"
                assert given.get("shell", "False") == "False", f"{file}:{node.lineno}"
            elif isinstance(node, (ast.Import, ast.ImportFrom)):
                names = {alias.name for alias in node.names} | {getattr(node, "module", None)}
                assert not names & unsafe_modules, f"{file}:{node.lineno}"
