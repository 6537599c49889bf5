"""policy.onnx: the policy as one graph, from what is measured to what is commanded, compared with its arrays."""

import importlib.util
import json
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from studio.export.policy import Policy
from studio.robots.robot import Program, Quantity

FILE = "policy.onnx"
MISSING = 'what writes and reads it is missing: pip install "morph-studio[onnx]"'
"""What is said where there is no policy.onnx, or nothing to read it with."""
ALLOWED = 1e-5
"""Largest difference between the graph and the arrays that is allowed, as a share of the largest action; they are
single precision. The shipped policy.py has the same."""
PAIRS = 256
"""Number of observations on which both are compared."""
_OPSET, _IR = 17, 8
"""Versions of operators and file that readers of the last four years know."""
_OPERATORS = frozenset(("Gather", "Less", "Where", "Mul", "Sub", "Div", "Gemm", "Tanh", "Clip"))
"""Operators of which the graph consists: no other one is run."""
_LARGEST = 4 << 20
"""Largest file that is read, in bytes; the largest of today's policies has a hundred thousand."""


def is_available() -> bool:
    """Tell whether the extra `onnx` is installed, whose packages write and run the file."""
    return all(importlib.util.find_spec(package) for package in ("onnx", "onnxruntime"))


def onnx_file(policy: Policy, program: Program, facts: Mapping[str, object]) -> bytes:
    """Return the policy's mean as ONNX, with its `facts` among the metadata.

    Its one input `observation` (batch, o) and its one output `action` (batch, a) are in physical units; what their
    entries are is told by the metadata of the same names. Needs the extra `onnx`.
    """
    from onnx import TensorProto, checker, helper, numpy_helper

    units, constants, nodes = program.units, {}, []

    def constant(name: str, value: object, kind: type = np.float32) -> str:
        constants[name] = np.array(value, kind)
        return name

    def node(operator: str, *inputs: str, to: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(operator, list(inputs), [to], name=to, **attributes))
        return to

    x = "observation"
    if (w := program.orientation) is not None:  # q and -q are the same orientation
        signs = np.ones(len(program.sees))
        signs[w : w + 4] = -1
        real = node("Gather", x, constant("w", [w], np.int64), to="real_part", axis=1)
        turned = node("Less", real, constant("zero", 0), to="is_negative")
        sign = node("Where", turned, constant("turned", signs), constant("as_it_is", np.abs(signs)), to="sign")
        x = node("Mul", x, sign, to="upright")
    x = node("Sub", x, constant("middle", units["middle"]), to="centred")
    x = node("Div", x, constant("spread", units["spread"]), to="normalised")
    last = len(policy.weights) - 1
    for i, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        named = constant(f"weight_{i}", weight), constant(f"bias_{i}", bias)
        x = node("Gemm", x, *named, to=f"layer_{i}", transB=1)
        x = node("Tanh", x, to=f"tanh_{i}") if i < last else x
    x = node("Clip", x, constant("lowest", -1), constant("highest", 1), to="mean")
    node("Mul", x, constant("action_scale", units["action_scale"]), to="action")
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["batch", len(program.sees)])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["batch", len(program.gives)])],
        [numpy_helper.from_array(array, name) for name, array in constants.items()],
    )
    model = helper.make_model(
        graph, producer_name="morph-studio", ir_version=_IR, opset_imports=[helper.make_opsetid("", _OPSET)]
    )
    told = {"observation": _told(program.sees), "action": _told(program.gives)}
    helper.set_model_props(model, told | _in_words(facts))
    checker.check_model(model, full_check=True)
    return model.SerializeToString(deterministic=True)


def other_facts(content: bytes, program: Program, facts: Mapping[str, object]) -> list[str]:
    """Return which of the `facts` among the metadata of a policy.onnx are others, or what its entries are; what it
    does not tell is no other. Needs the extra `onnx`."""
    import onnx

    said = {p.key: p.value for p in onnx.load_model_from_string(_screened(content)).metadata_props}
    known = {"observation": _told(program.sees), "action": _told(program.gives)} | _in_words(facts)
    return sorted(key for key, value in known.items() if said.get(key, value) != value)


def _in_words(facts: Mapping[str, object]) -> dict[str, str]:
    return {name: value if isinstance(value, str) else json.dumps(value) for name, value in facts.items()}


def _told(quantities: Iterable[Quantity]) -> str:
    """Return the names and units of quantities, in their order, as JSON."""
    return json.dumps([{"name": name, "unit": unit} for name, unit in quantities])


def off_from_arrays(content: bytes, policy: Policy, program: Program) -> float:
    """Return the largest difference between a policy.onnx and the arrays, as a share of the largest action.

    Raise ValueError for a file that asks for more than such a graph needs. Needs the extra `onnx`.
    """
    units, rng = program.units, np.random.default_rng(0)
    seen = units["middle"] + units["spread"] * rng.standard_normal((PAIRS, len(program.sees)))
    seen = seen.astype(np.float32)
    found, known = _run(_screened(content), seen), policy.command(seen, program)
    if found.shape != known.shape:
        raise ValueError(f"its actions have the shape {found.shape}, not {known.shape}")
    off = np.abs(found - known) / np.maximum(units["action_scale"], 1e-300)
    return float(off.max()) if np.isfinite(off).all() else np.inf


def _screened(content: bytes) -> bytes:
    """Return a stranger's file as it was read; ValueError for one that fetches files, or runs anything but what a
    policy is made of."""
    if len(content) > _LARGEST:
        raise ValueError(f"it has more than {_LARGEST >> 20} MiB")
    import onnx

    model = onnx.load_model_from_string(content)
    if model.functions or any(opset.domain for opset in model.opset_import):
        raise ValueError("it has functions or operators of its own")
    strange = {node.op_type for node in model.graph.node if node.domain or node.op_type not in _OPERATORS}
    if strange:
        raise ValueError(f"it has operators that no policy needs: {', '.join(sorted(strange))[:80]}")
    if model.graph.sparse_initializer or any(t.external_data or t.data_location for t in model.graph.initializer):
        raise ValueError("its numbers are not in the file")
    return model.SerializeToString()


def _run(content: bytes, seen: np.ndarray) -> np.ndarray:
    """Return the actions of a graph that was screened."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    return np.asarray(session.run(["action"], {"observation": seen})[0])
