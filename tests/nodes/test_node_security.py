"""What is closed by default, and the policy file that says what each node may do."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import pytest

from dopslam_ros.bag import BagWriter
from dopslam_ros.cli.commands.parameters import NODES
from dopslam_ros.messages import topics
from dopslam_ros.nodes.bounds import BoundsNode
from dopslam_ros.nodes.filter import FilterNode
from dopslam_ros.nodes.player import PlayerNode
from dopslam_ros.nodes.recorder import RecorderNode
from dopslam_ros.nodes.simulator import SimulatorNode

if TYPE_CHECKING:
    from tests.conftest import Ros

ROOT = Path(__file__).resolve().parents[2]
POLICY = ROOT / "config" / "sros2_policy.xml"
RULES = (("topics", "publish"), ("topics", "subscribe"), ("services", "reply"))
# Tells the range a node's process has come to, from within, where the middleware reads it.
TELL_RANGE = """
import os
import rclpy
rclpy.init = lambda **options: print(os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"])
from dopslam_ros.nodes import running
running._spin = lambda create: 0
running.run(None)
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
@pytest.mark.parametrize("node", sorted(NODES))
def test_the_policy_is_what_the_nodes_do(
    ros: Ros, tmp_path: Path, scene: Path, node: str, namespace: str
) -> None:
    """No topic or service more, none less; /clock is heard only with simulated time, /tf is
    published only with publish_tf."""
    bag = tmp_path / "played"
    with BagWriter(bag) as writer:
        for topic in (topics.FILTER_EVENTS, *topics.INPUTS, *topics.OUTPUTS):
            writer.add_topic(f"{namespace.rstrip('/')}/{topic.name}", topic.type_name)
    kind, parameters = {
        "simulator": (SimulatorNode, {"scenario": str(scene), "wait_for_nodes": "nobody"}),
        "filter": (FilterNode, {"publish_tf": True}),
        "bounds": (BoundsNode, {}),
        "recorder": (RecorderNode, {"bag": str(tmp_path / "bag")}),
        "player": (PlayerNode, {"bag": str(bag), "outputs": True, "wait_for_nodes": "nobody"}),
    }[node]
    ros.start(kind, namespace=namespace, use_sim_time=True, **parameters)
    assert created(ros, node, namespace) == allowed(node, namespace)


# What the schema of sros2 (policy 0.2.0) asks for, by element: the attributes it must have, those
# it may have, and the elements in it, at least one where there are any.
ALLOW_OR_DENY = ("ALLOW", "DENY")
FORM: dict[str, tuple[set[str], set[str], set[str]]] = {
    "policy": ({"version"}, set(), {"enclaves"}),
    "enclaves": (set(), set(), {"enclave"}),
    "enclave": ({"path"}, set(), {"profiles"}),
    "profiles": (set(), {"type"}, {"profile"}),
    "profile": ({"ns", "node"}, set(), {"topics", "services"}),
    "topics": (set(), {"publish", "subscribe"}, {"topic"}),
    "services": (set(), {"reply", "request"}, {"service"}),
    "topic": (set(), set(), set()),
    "service": (set(), set(), set()),
}


def faults(element: ElementTree.Element) -> list[str]:
    """What the schema would not take, and what sros2 would translate into nothing."""
    needed, optional, inner = FORM[element.tag]
    given = set(element.attrib)
    found = [f"{element.tag} without {name}" for name in sorted(needed - given)]
    found += [f"{element.tag} with {name}" for name in sorted(given - needed - optional)]
    if element.tag in ("topics", "services"):
        values = list(element.attrib.values())
        found += [f"{value} is no rule" for value in values if value not in ALLOW_OR_DENY]
        found += [f"{element.tag} that rule nothing"] if not values else []
    if inner and not len(element):
        found.append(f"{element.tag} is empty")
    if not inner and not re.fullmatch(r"(/|~/)?[a-z_]+(/[a-z_]+)*", element.text or ""):
        found.append(f"'{element.text}' is no name")
    for child in element:
        if child.tag in inner:
            found += faults(child)
        else:
            found.append(f"{child.tag} in {element.tag}")
    return found


def test_the_policy_has_the_form_that_sros2_reads() -> None:
    """As its schema says, and an enclave for each executable, with its one profile."""
    root = ElementTree.parse(POLICY).getroot()
    assert root.tag == "policy" and not faults(root)
    assert root.get("version") == "0.2.0" and len(root) == 1
    nodes = []
    for enclave in root.iter("enclave"):
        ((profile,),) = enclave
        assert profile.get("ns") == "/"
        assert enclave.get("path") == f"/dopslam/{profile.get('node')}"
        nodes.append(profile.get("node"))
        rules = [(r.tag, *r.attrib) for r in profile]
        assert len(rules) == len(set(rules)) and set(rules) <= set(RULES)
    assert sorted(nodes) == sorted(NODES)


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        (' version="0.2.0"', "", "policy without version"),
        (' node="filter"', "", "profile without node"),
        ('publish="ALLOW"', 'publish="allow"', "allow is no rule"),
        ('publish="ALLOW"', 'publishes="ALLOW"', "topics with publishes"),
        ("<topic>ue_state</topic>", "<topic>ue state</topic>", "'ue state' is no name"),
        ("<topic>ue_state</topic>", "<service>ue_state</service>", "service in topics"),
    ],
)
def test_a_policy_of_another_form_is_noticed(old: str, new: str, fault: str) -> None:
    """Each of what the schema forbids, put into our file."""
    text = POLICY.read_text("utf-8")
    assert old in text
    assert fault in faults(ElementTree.fromstring(text.replace(old, new)))


def test_the_policy_knows_every_topic() -> None:
    """Each topic of the package is published by a node and heard by another."""
    rules = [allowed(node, "/") for node in NODES]
    every = {topic.name for topic in (topics.FILTER_EVENTS, *topics.RECORDED)}
    full = {name if name.startswith("/") else f"/{name}" for name in every}
    for rule in ("publish", "subscribe"):
        assert full <= set().union(*(found[rule] for found in rules)), rule


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
