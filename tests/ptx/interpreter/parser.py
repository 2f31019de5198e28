"""PTX text to a list of instructions, with the kernel's parameters, registers, labels and static memory."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from ptx.interpreter.errors import UnknownInstruction

__all__ = ["KINDS", "LOCAL", "SHARED", "Instruction", "Program", "parse"]

SHARED, LOCAL = 0x0100_0000, 0x1000_0000
"""First addresses of a block's shared and of a thread's local memory; global arrays lie higher (`memory.py`)."""

KINDS = {
    **{f"{letter}{8 * size}": f"{kind}{size}" for size in (1, 2, 4, 8) for letter, kind in ("uu", "si", "bu")},
    "f16": "f2", "f32": "f4", "f64": "f8", "pred": "?",
}  # fmt: skip
"""numpy's name of each type of PTX."""


@dataclass(frozen=True)
class Instruction:
    """One instruction: ``@!%p1 ld.global.u32 %r1, [%rd1+4]``."""

    guard: str | None  # register of the predicate
    inverted: bool
    op: tuple[str, ...]
    operands: tuple[str, ...]
    text: str


@dataclass
class Program:
    """One kernel."""

    name: str
    parameters: list[tuple[str, str]]  # type and name
    code: list[Instruction] = field(default_factory=list)
    labels: dict[str, int] = field(default_factory=dict)
    registers: dict[str, str] = field(default_factory=dict)  # name without % to numpy's type
    symbols: dict[str, int] = field(default_factory=dict)  # address of shared and local arrays
    constants: dict[str, np.ndarray] = field(default_factory=dict)
    shared: int = 0  # bytes of a block
    local: int = 0  # bytes of a thread


def _body(text: str, start: int) -> str:
    depth, at = 1, start
    while depth:
        depth += {"{": 1, "}": -1}.get(text[at], 0)
        at += 1
    return text[start : at - 1]


def _operands(text: str) -> tuple[str, ...]:
    """Split at the commas that are not in brackets."""
    return tuple(part.strip() for part in re.findall(r"(?:\{[^}]*\}|\[[^\]]*\]|[^,\[{])+", text) if part.strip())


def _place(address: int, align: int, size: int) -> tuple[int, int]:
    start = -(-address // align) * align
    return start, start + size


def _memory(text: str, program: Program) -> None:
    array = r"\.align\s+(\d+)\s+\.(\w+)\s+([\w$.]+)(?:\[(\d*)\])?"
    for align, kind, name, count in re.findall(r"\.shared\s+" + array, text):
        size = int(count or 1) * np.dtype(KINDS[kind]).itemsize
        start, program.shared = _place(program.shared, int(align), size)
        program.symbols[name] = SHARED + start
    for align, kind, name, count in re.findall(r"\.local\s+" + array, text):
        start, program.local = _place(program.local, int(align), int(count or 1) * np.dtype(KINDS[kind]).itemsize)
        program.symbols[name] = LOCAL + start
    for kind, name, values in re.findall(
        r"\.(?:global|const)\s+\.align\s+\d+\s+\.(\w+)\s+([\w$.]+)\[\d*\]\s*=\s*\{([^}]*)\}", text
    ):
        program.constants[name] = np.array([int(value, 0) for value in values.split(",")], KINDS[kind])


def parse(text: str) -> Program:
    """Return the one kernel in a PTX text."""
    text = re.sub(r"/\*.*?\*/|//[^\n]*", "", text, flags=re.S)
    entry = re.search(r"\.entry\s+([\w$.]+)\s*\((.*?)\)[^{;]*\{", text, re.S)
    if entry is None or re.search(r"^\s*(?:\.visible\s+)?\.func\s", text, re.M):
        raise UnknownInstruction("want PTX with one kernel and no functions: a helper was not inlined")
    parameters = re.findall(r"\.param\s+(?:\.align\s+\d+\s+)?\.(\w+)\s+([\w$.]+)", entry[2])
    program = Program(entry[1], parameters)
    _memory(text, program)
    body = _body(text, entry.end())
    for kind, name, count in re.findall(r"\.reg\s+\.(\w+)\s+%(\w+)<(\d+)>", body):
        for number in range(int(count)):
            program.registers[f"{name}{number}"] = KINDS[kind].replace("i", "u")
    for kind, names in re.findall(r"\.reg\s+\.(\w+)\s+((?:%?\w+\s*,?\s*)+);", body):
        for name in re.findall(r"%?(\w+)", names):
            program.registers[name] = KINDS[kind].replace("i", "u")
    body = re.sub(r"(?:^|(?<=[;{}\n]))\s*\.(reg|local|shared|pragma|param)\b[^;]*;", "", body)
    body = re.sub(r"^\s*\.(loc|file|section)\b[^\n]*$", "", body, flags=re.M)
    body = re.sub(r"^\s*[{}]\s*$", "", body, flags=re.M)
    for statement in body.split(";"):
        statement = statement.strip()
        while label := re.match(r"([\w$]+):\s*", statement):
            program.labels[label[1]] = len(program.code)
            statement = statement[label.end() :]
        if not statement:
            continue
        parts = re.match(r"(?:@(!?)%(\w+)\s+)?([a-z][\w.:]*)\s*(.*)$", statement, re.S)
        if parts is None:
            raise UnknownInstruction(f"cannot read {statement!r}")
        inverted, guard, op, rest = parts.groups()
        text_of = re.sub(r"\s+", " ", statement)
        program.code.append(Instruction(guard, bool(inverted), tuple(op.split(".")), _operands(rest), text_of))
    return program
