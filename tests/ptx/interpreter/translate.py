"""Instructions to Python: each straight run of a kernel becomes one function on numpy arrays of lanes.

A function takes the machine and the lanes that run it (None for all), fetches the registers it needs, computes in
local variables and puts back those that someone reads later. It returns the instruction at which all its lanes go on,
or a mask and two of them. Shuffles and votes are computed on the way while whole warps run; otherwise the function
returns early and the machine waits for the missing lanes.
"""

from __future__ import annotations

import re
import struct
from typing import Any

import numpy as np

from ptx.interpreter.arithmetic import FUNCTIONS
from ptx.interpreter.errors import UnknownInstruction
from ptx.interpreter.parser import KINDS, Instruction, Program

__all__ = ["EXIT", "Translation", "is_barrier", "is_warp_operation"]

EXIT = -1
"""Target of lanes that return."""

_COMPARE = {
    "eq": "==",
    "ne": "!=",
    "lt": "<",
    "le": "<=",
    "gt": ">",
    "ge": ">=",
    "lo": "<",
    "ls": "<=",
    "hi": ">",
    "hs": ">=",
}
_HARMLESS = {"membar", "fence", "nanosleep", "prefetch", "prefetchu"}
_SPACES = ("global", "shared", "local", "param", "const")
_ATOMS = ("add", "min", "max", "and", "or", "xor", "exch", "cas")
_APPROXIMATE = {
    "sqrt": "np.sqrt({0})", "rcp": "1 / {0}", "rsqrt": "1 / np.sqrt({0})", "ex2": "np.exp2({0})", "lg2": "np.log2({0})",
    "sin": "np.sin({0})", "cos": "np.cos({0})", "tanh": "np.tanh({0})",
}  # fmt: skip
_ROUNDINGS = {"rn", "approx", "full", "ftz", "sat", "lo", "hi", "wide", "NaN"}


def is_warp_operation(instruction: Instruction) -> bool:
    """Return whether lanes of a warp meet here."""
    op = instruction.op
    return op[0] in ("shfl", "vote", "match", "redux", "activemask", "elect") or op[:2] == ("bar", "warp")


def is_barrier(instruction: Instruction) -> bool:
    """Return whether the threads of a block meet here."""
    return instruction.op[0] in ("bar", "barrier") and instruction.op[:2] != ("bar", "warp")


def _registers(text: str) -> list[str]:
    return [name for name in re.findall(r"%([A-Za-z_]\w*(?:\.[xyz])?)", text) if "." not in name]


def _outputs(instruction: Instruction) -> list[str]:
    """Return the registers that an instruction writes."""
    op = instruction.op
    if op[0] in ("st", "red", "bra", "ret", "exit", "bar", "barrier", "trap", *_HARMLESS) or not instruction.operands:
        return []
    return _registers(instruction.operands[0])


class Translation:
    """A kernel with the functions of its straight runs, translated when they are first needed."""

    def __init__(self, program: Program) -> None:
        self.program = program
        code = program.code
        self.outputs = [_outputs(one) for one in code]
        self.inputs = [self._inputs(one, outputs) for one, outputs in zip(code, self.outputs, strict=True)]
        self.leaders = {0, *program.labels.values()}
        for at, one in enumerate(code):
            if one.op[0] in ("bra", "ret", "exit") or is_barrier(one):
                self.leaders.add(at + 1)
        self.alive = self._liveness()
        definitions: dict[str, list[int]] = {}
        for at, names in enumerate(self.outputs):
            for name in names:
                definitions.setdefault(name, []).append(at)
        self.constant: dict[str, int] = {}  # registers that only ever hold one immediate value
        for name, places in definitions.items():
            one = code[places[0]]
            if len(places) == 1 and one.op[0] == "mov" and one.guard is None:
                if re.fullmatch(r"-?\d+|0x[0-9a-fA-F]+", one.operands[1]):
                    self.constant[name] = int(one.operands[1], 0)
        self._functions: dict[int, Any] = {}

    @staticmethod
    def _inputs(one: Instruction, outputs: list[str]) -> list[str]:
        operands = one.operands if not outputs else one.operands[1:]
        names = [name for operand in operands for name in _registers(operand)]
        if one.guard:
            names += [one.guard, *outputs]
        return [name for name in names if name not in ("laneid", "warpid")]

    def after(self, at: int) -> list[int]:
        """Return the instructions that may follow."""
        one = self.program.code[at]
        following = [at + 1] if at + 1 < len(self.program.code) else []
        if one.op[0] == "bra":
            target = self.program.labels[one.operands[0]]
            return [target] if one.guard is None else [target, *following]
        if one.op[0] in ("ret", "exit"):
            return following if one.guard else []
        return following

    def _liveness(self) -> list[set[str]]:
        """Return the registers that are read after each instruction is reached."""
        count = len(self.program.code)
        alive: list[set[str]] = [set() for _ in range(count + 1)]
        changed = True
        while changed:
            changed = False
            for at in range(count - 1, -1, -1):
                after: set[str] = set()
                for following in self.after(at):
                    after |= alive[following]
                now = (after - set(self.outputs[at])) | set(self.inputs[at])
                if now != alive[at]:
                    alive[at] = now
                    changed = True
        return alive

    def function(self, at: int) -> Any:
        """Return the function that runs from instruction `at` on."""
        if at not in self._functions:
            self._functions[at] = _Writer(self, at).compile()
        return self._functions[at]


class _Writer:
    """Writes one function."""

    def __init__(self, translation: Translation, start: int) -> None:
        self.translation = translation
        self.program = translation.program
        self.start = start
        self.lines: list[str] = []
        self.names: dict[str, Any] = {"np": np, **FUNCTIONS}
        self.needed: list[str] = []
        self.written: dict[str, None] = {}
        self.meets = False

    # ------------------------------------------------------------------ the run as a whole
    def compile(self) -> Any:
        code, at = self.program.code, self.start
        while True:
            if at >= len(code):
                self.leave(EXIT, set())
                break
            one = code[at]
            if at != self.start and (at in self.translation.leaders or is_barrier(one)):
                self.leave(at, self.translation.alive[at])
                break
            if is_barrier(one):
                raise AssertionError("barriers are the machine's")
            if one.op[0] in ("bra", "ret", "exit"):
                self.branch(at, one)
                break
            for name in self.translation.inputs[at]:
                self.fetch(name)
            self.instruction(at, one)
            at += 1
        head = [f"def run(m, R, i, n{', whole' if self.meets else ''}):"]
        if self.needed:
            head.append(" if i is None:")
            head += [f"  {self.local(name)} = R[{name!r}]" for name in self.needed]
            head.append(" else:")
            head += [f"  {self.local(name)} = R[{name!r}][i]" for name in self.needed]
        exec(compile("\n".join(head + self.lines), f"<{self.program.name[-30:]}:{self.start}>", "exec"), self.names)
        function = self.names["run"]
        return function, self.meets, at - self.start + 1

    def local(self, name: str) -> str:
        return "v_" + name.replace(".", "_")

    def fetch(self, name: str) -> None:
        if name not in self.written and name not in self.needed:
            self.needed.append(name)

    def save(self, alive: set[str], indent: str = " ") -> None:
        names = [name for name in self.written if name in alive]
        if names:
            self.lines.append(f"{indent}if i is None:")
            self.lines += [f"{indent} R[{name!r}] = {self.local(name)}" for name in names]
            self.lines.append(f"{indent}else:")
            self.lines += [f"{indent} R[{name!r}][i] = {self.local(name)}" for name in names]

    def leave(self, target: int, alive: set[str]) -> None:
        self.save(alive)
        self.lines.append(f" return {target}")

    def branch(self, at: int, one: Instruction) -> None:
        target = self.program.labels[one.operands[0]] if one.op[0] == "bra" else EXIT
        alive: set[str] = set()
        for following in self.translation.after(at):
            alive |= self.translation.alive[following]
        if one.guard is None:
            self.leave(target, alive)
            return
        self.fetch(one.guard)
        self.save(alive)
        self.lines.append(
            f" return {self.local(one.guard)}, {', '.join(map(str, (target, at + 1)[:: -1 if one.inverted else 1]))}"
        )

    # ------------------------------------------------------------------ operands
    def constant(self, value: Any) -> str:
        name = f"K{len(self.names)}"
        self.names[name] = value
        return name

    def source(self, operand: str, kind: str) -> str:
        """Return an expression for an operand as numpy's type `kind`."""
        size = 0 if kind == "?" else int(kind[1:])
        if operand.startswith("%"):
            name = operand[1:]
            if name.split(".")[0] in ("tid", "ntid", "ctaid", "nctaid", "laneid"):
                return self.cast(f"m.special({name!r}, i, n)", "u4", kind)
            if name not in self.program.registers:
                raise UnknownInstruction(f"special register {operand}")
            return self.cast(self.local(name), self.program.registers[name], kind)
        if operand.startswith("-%") or operand.startswith("!"):
            raise UnknownInstruction(f"operand {operand}")
        if operand in self.program.symbols:
            return self.constant(np.uint64(self.program.symbols[operand]).astype(kind))
        if operand in self.program.constants:
            return f"m.address_of({operand!r}).astype({kind!r})"
        if operand[:2] in ("0f", "0F"):
            return self.constant(np.array(struct.unpack(">f", bytes.fromhex(operand[2:]))[0], "f4")[()].astype(kind))
        if operand[:2] in ("0d", "0D"):
            return self.constant(np.array(struct.unpack(">d", bytes.fromhex(operand[2:]))[0], "f8")[()].astype(kind))
        try:
            number = int(operand, 0)
        except ValueError:
            raise UnknownInstruction(f"operand {operand}") from None
        if kind == "?":
            return self.constant(np.bool_(number))
        bits = np.array(number & (2 ** (8 * size) - 1), np.uint64).astype(f"u{size}")
        return self.constant(bits.view(kind)[()])

    @staticmethod
    def cast(expression: str, have: str, want: str) -> str:
        """Return an expression of the same low bits as another type."""
        if have == want:
            return expression
        if "?" in (have, want):
            raise UnknownInstruction("a predicate as a number")
        if have[1:] == want[1:]:
            return f"{expression}.view({want!r})"
        if have[0] == "f" or want[0] == "f":
            raise UnknownInstruction(f"{have} as {want}")
        return f"{expression}.astype({want!r})"

    def assign(self, operand: str, expression: str, kind: str, one: Instruction) -> None:
        """Write an expression of numpy's type `kind`, a new array, to a register."""
        name = operand.lstrip("%")
        if operand == "_":
            self.lines.append(f" {expression}")
            return
        if name not in self.program.registers:
            raise UnknownInstruction(f"register {operand} in {one.text}")
        register_kind = self.program.registers[name]
        if kind != register_kind:
            if "?" not in (kind, register_kind) and int(register_kind[1:]) > int(kind[1:]) and kind[0] == "i":
                expression = f"({expression}).astype('i{register_kind[1:]}').view({register_kind!r})"
            else:
                expression = self.cast(f"({expression})", kind, register_kind)
        if one.guard:
            guard = f"~{self.local(one.guard)}" if one.inverted else self.local(one.guard)
            expression = f"np.where({guard}, {expression}, {self.local(name)})"
        self.lines.append(f" {self.local(name)} = {expression}")
        self.written[name] = None

    # ------------------------------------------------------------------ instructions
    def instruction(self, at: int, one: Instruction) -> None:
        op = one.op[0]
        if op in _HARMLESS:
            return
        if is_warp_operation(one):
            self.warp_operation(at, one)
        elif op in ("ld", "ldu", "st", "atom", "red"):
            self.memory(at, one)
        elif op == "trap":
            self.lines.append(f" m.trap({at}, i)")
        elif op == "mov":
            self.move(one)
        elif op == "setp":
            self.compare(one)
        else:
            kind, expression = self.value(one)
            self.assign(one.operands[0], expression, kind, one)

    def unknown(self, one: Instruction) -> UnknownInstruction:
        return UnknownInstruction(one.text)

    def value(self, one: Instruction) -> tuple[str, str]:
        """Return the type and the expression of an instruction that computes one value."""
        op, kind = one.op[0], KINDS.get(one.op[-1])
        middle = set(one.op[1:-1])
        if kind is None:
            raise self.unknown(one)
        if op == "cvta":
            return "u8", f"({self.source(one.operands[1], 'u8')}).copy()"
        if op == "cvt":
            have, want = kind, KINDS[one.op[-2]]
            rounding = next((word for word in one.op if word in ("rni", "rzi", "rmi", "rpi")), None)
            if middle & {"rz", "rm", "rp"}:
                raise self.unknown(one)
            name = one.operands[1]
            register_kind = self.program.registers.get(name[1:], have)
            source = self.source(name, have if have[1:] == register_kind[1:] or have[0] == "f" else f"u{have[1:]}")
            if have[0] == "i" and have[1:] != register_kind[1:]:
                source += f".view({have!r})"
            return want, f"convert({source}, {want!r}, {rounding!r}, {'sat' in one.op})"
        if op == "selp":
            a, b = (self.source(name, kind) for name in one.operands[1:3])
            return kind, f"np.where({self.source(one.operands[3], '?')}, {a}, {b})"
        size = 0 if kind == "?" else int(kind[1:])
        integer, floating = kind[0] in "iu", kind[0] == "f"
        shifts = {"shl": (1,), "shr": (1,), "bfe": (1, 2), "bfi": (2, 3), "shf": (2,)}.get(op, ())
        sources = [self.source(name, "u4" if k in shifts else kind) for k, name in enumerate(one.operands[1:])]
        a, b, c, d = [*sources, "", "", "", ""][:4]
        if (op in ("add", "sub", "mul", "mad", "fma") and kind in ("f2",)) or (floating and middle - _ROUNDINGS):
            raise self.unknown(one)
        if op in ("add", "sub") and not middle & {"cc"}:
            sign = "+" if op == "add" else "-"
            if "sat" in middle and kind == "i4":
                return kind, f"saturated({a}.astype('i8') {sign} {b}.astype('i8'), 'i4')"
            if "sat" in middle:
                raise self.unknown(one)
            return kind, f"{a} {sign} {b}"
        if op in ("mul", "mad") and "wide" in middle:
            wide = f"{kind[0]}{2 * size}"
            tail = f" + {self.source(one.operands[3], wide)}" if op == "mad" else ""
            return wide, f"{a}.astype({wide!r}) * {b}.astype({wide!r}){tail}"
        if op in ("mul", "mad") and integer:
            product = f"high({a}, {b})" if "hi" in middle else f"{a} * {b}"
            return kind, product + (f" + {c}" if op == "mad" else "")
        if op == "mul" and "sat" not in middle:
            return kind, f"{a} * {b}"
        if op in ("fma", "mad") and kind == "f4" and "sat" not in middle:
            return kind, f"fma({a}, {b}, {c})"
        if op == "div":
            return kind, f"{a} / {b}" if floating else f"divide({a}, {b})"
        if op == "rem" and integer:
            return kind, f"remainder({a}, {b})"
        if op in ("min", "max"):
            name = {"min": "minimum", "max": "maximum"}[op] if integer or "NaN" in middle else f"f{op}"
            return kind, f"np.{name}({a}, {b})"
        if op in ("and", "or", "xor"):
            return kind, f"{a} {dict(zip(('and', 'or', 'xor'), '&|^', strict=True))[op]} {b}"
        if op == "not":
            return kind, f"~{a}"
        if op == "neg":
            return kind, f"-{a}"
        if op == "abs":
            return kind, f"np.abs({a})"
        if op == "sad" and integer:
            return kind, f"np.maximum({a}, {b}) - np.minimum({a}, {b}) + {c}"
        if op == "copysign":
            return kind, f"np.copysign({b}, {a})"
        if op in ("shl", "shr"):
            return kind, f"{'shift_left' if op == 'shl' else 'shift_right'}({a}, {b})"
        if op == "shf":
            return kind, f"funnel({a}, {b}, {c}, {'l' in middle}, {'wrap' in middle})"
        if op == "bfi":
            return kind, f"insert_bits({a}, {b}, {c}, {d})"
        if op == "bfe":
            return kind, f"extract_bits({a}, {b}, {c})"
        if op == "prmt" and not middle:
            return kind, f"permute({a}, {b}, {c})"
        if op == "lop3" and not middle:
            return kind, f"logic3({a}, {b}, {c}, {int(one.operands[4], 0)})"
        if op == "popc":
            return "u4", f"np.bitwise_count({a}).astype('u4')"
        if op == "clz":
            return "u4", f"leading_zeros({a})"
        if op == "bfind":
            return "u4", f"find_bit({a}, {'shiftamt' in middle})"
        if op == "brev":
            return kind, f"reverse({a})"
        if op in ("dp4a", "dp2a"):
            a = self.source(one.operands[1], KINDS[one.op[-2]])
            return "u4", f"dot({a}, {b}, {c}, {4 if op == 'dp4a' else 2}, {'hi' in middle})"
        if op in _APPROXIMATE and floating:
            return kind, f"({_APPROXIMATE[op].format(a)}).astype({kind!r})"
        raise self.unknown(one)

    def move(self, one: Instruction) -> None:
        kind = KINDS[one.op[-1]]
        to, what = one.operands
        if what.startswith("{"):  # pack
            parts = [part.strip() for part in what[1:-1].split(",")]
            width = 8 * int(kind[1:]) // len(parts)
            terms = [
                f"({self.source(part, f'u{width // 8}')}.astype('u8') << np.uint64({k * width}))"
                for k, part in enumerate(parts)
            ]
            self.assign(to, f"({' | '.join(terms)}).astype('u{kind[1:]}')", f"u{kind[1:]}", one)
        elif to.startswith("{"):  # unpack
            parts = [part.strip() for part in to[1:-1].split(",")]
            width = 8 * int(kind[1:]) // len(parts)
            self.lines.append(f" packed = {self.source(what, f'u{kind[1:]}')}")
            for k, part in enumerate(parts):
                if part != "_":
                    piece = f"(packed >> packed.dtype.type({k * width})).astype('u{width // 8}')"
                    self.assign(part, piece, f"u{width // 8}", one)
        elif what.startswith("%"):
            self.assign(to, f"{self.source(what, kind)}.copy()", kind, one)
        else:
            self.assign(to, f"np.full(n, {self.source(what, kind)})", kind, one)

    def compare(self, one: Instruction) -> None:
        kind = KINDS[one.op[-1]]
        a, b = (self.source(name, kind) for name in one.operands[1:3])
        how = one.op[1]
        if kind == "?" and how in ("eq", "ne"):
            result = f"({a} {_COMPARE[how]} {b})"
        elif how in ("num", "nan"):
            result = f"{'~' if how == 'num' else ''}unordered({a}, {b})"
        elif kind[0] == "f" and how == "ne":  # false where either is NaN
            result = f"(({a} < {b}) | ({a} > {b}))"
        elif kind[0] == "f" and how.endswith("u") and how[:-1] in _COMPARE:
            result = f"(({a} {_COMPARE[how[:-1]]} {b}) | unordered({a}, {b}))"
        elif how in _COMPARE:
            result = f"({a} {_COMPARE[how]} {b})"
        else:
            raise self.unknown(one)
        to = one.operands[0].split("|")
        both = [result, f"~{result}"]
        if len(one.operands) == 4:
            sign = {"and": "&", "or": "|", "xor": "^"}[one.op[2]]
            both = [f"{result} {sign} {self.source(one.operands[3], '?')}" for result in both]
        for name, expression in zip(to, both, strict=False):
            self.assign(name.strip(), expression, "?", one)

    # ------------------------------------------------------------------ memory
    def memory(self, at: int, one: Instruction) -> None:
        op = one.op[0]
        space = next((word for word in one.op if word in _SPACES), "generic")
        if one.op[-1] not in KINDS:
            raise self.unknown(one)
        kind = KINDS[one.op[-1]]
        count = 4 if "v4" in one.op else 2 if "v2" in one.op else 1
        where = "None" if not one.guard else f"{'~' * one.inverted}{self.local(one.guard)}"
        place = one.operands[0 if op in ("st", "red") else 1]
        inside = re.fullmatch(r"\[\s*([%\w$.]+)\s*(?:\+\s*(-?\w+))?\s*\]", place)
        if inside is None:
            raise self.unknown(one)
        base, offset = inside[1], int(inside[2] or "0", 0)
        if space == "param":
            self.assign(one.operands[0], f"np.full(n, m.parameter({base!r}, {kind!r}))", kind, one)
            return
        address = self.source(base, "u8")
        if not base.startswith("%"):
            address = f"np.full(n, {address})"
        if offset:
            address = f"{address} + {self.constant(np.uint64(offset & (2**64 - 1)))}"
        strong = bool(set(one.op) & {"volatile", "relaxed", "acquire", "release"})
        if op in ("ld", "ldu"):
            names = [name.strip() for name in one.operands[0].strip("{}").split(",")]
            self.lines.append(f" got = m.load({at}, {space!r}, {address}, {kind!r}, {count}, i, {where}, {strong})")
            for k, name in enumerate(names):
                piece = "got" if count == 1 else f"got[:, {k}].copy()"
                if name != "_":
                    self.assign(name, piece, kind, one)
        elif op == "st":
            names = [name.strip() for name in one.operands[1].strip("{}").split(",")]
            values = ", ".join(self.stored(name, kind) for name in names)
            self.lines.append(
                f" m.store({at}, {space!r}, {address}, {kind!r}, {count}, ({values},), i, n, {where}, {strong})"
            )
        else:
            name = next((word for word in one.op[1:] if word in _ATOMS), None)
            if name is None or kind == "f2":
                raise self.unknown(one)
            values = ", ".join(self.source(v, kind) for v in one.operands[1 if op == "red" else 2 :])
            wanted = op == "atom" and any(out in self.translation.alive[at + 1] or out for out in _outputs(one))
            call = f"m.atomic({at}, {space!r}, {address}, {kind!r}, {name!r}, ({values},), i, n, {where})"
            if wanted:
                self.assign(one.operands[0], call, kind, one)
            else:
                self.lines.append(f" {call}")

    def stored(self, operand: str, kind: str) -> str:
        if operand.startswith("%"):
            register_kind = self.program.registers[operand[1:]]
            if register_kind[1:] != kind[1:]:
                return f"{self.local(operand[1:])}.astype('u{kind[1:]}').view({kind!r})"
        return self.source(operand, kind)

    # ------------------------------------------------------------------ lanes of a warp together
    def warp_operation(self, at: int, one: Instruction) -> None:
        if one.guard or one.op[0] in ("match", "elect"):
            raise self.unknown(one)
        self.meets = True
        alive = self.translation.alive[at]
        waits = f"not whole or not m.full({self.mask(one)})" if one.op[0] != "activemask" else "not whole"
        self.lines.append(f" if {waits}:")
        self.save(alive, "  ")
        self.lines.append(f"  return {at}")
        op, operands = one.op, one.operands
        if op[0] == "shfl":
            to, _, also = operands[0].partition("|")
            known = [self.known(name) for name in operands[2:4]]
            a = self.source(operands[1], "u4")
            if None not in known:
                table, valid = shuffle_table(op[2], *known)
                lanes = self.constant(table)
                self.assign(to, f"{a}.reshape(-1, 32)[:, {lanes}].reshape(-1)", "u4", one)
                if also and self.used(also, at):
                    self.assign(also, f"np.tile({self.constant(valid)}, n // 32)", "?", one)
            else:
                b, c = (self.source(name, "u4") for name in operands[2:4])
                self.lines.append(f" shuffled, valid = m.shuffle({op[2]!r}, {a}, {b}, {c}, n)")
                self.assign(to, "shuffled", "u4", one)
                if also and self.used(also, at):
                    self.assign(also, "valid", "?", one)
        elif op[0] == "vote":
            self.assign(
                operands[0],
                f"m.vote({op[2]!r}, {self.source(operands[1], '?')}, n)",
                "u4" if op[2] == "ballot" else "?",
                one,
            )
        elif op[0] == "redux":
            kind = KINDS[op[-1]]
            self.assign(operands[0], f"m.reduce({op[2]!r}, {self.source(operands[1], kind)}, n)", kind, one)
        elif op[0] == "activemask":
            self.assign(operands[0], "np.full(n, np.uint32(0xFFFFFFFF))", "u4", one)
        else:
            self.lines.append(" m.sync_warps(i)")

    def used(self, operand: str, at: int) -> bool:
        return operand.strip()[1:] in self.translation.alive[at + 1]

    def known(self, operand: str) -> int | None:
        if operand.startswith("%"):
            return self.translation.constant.get(operand[1:])
        return int(operand, 0)

    def mask(self, one: Instruction) -> str:
        value = self.known(one.operands[-1])
        if value is not None:
            return self.constant(np.uint32(value & 0xFFFFFFFF))
        return self.source(one.operands[-1], "u4")


def shuffle_table(mode: str, b: Any, c: Any, lane: Any = None) -> tuple[Any, Any]:
    """Return from which lane each lane gets its value, and whether that lane was in reach (PTX ISA 9.7.9.6)."""
    lane = np.arange(32) if lane is None else lane
    b, clamp, segment = (
        np.asarray(b).astype(np.int64) & 31,
        np.asarray(c).astype(np.int64) & 31,
        np.asarray(c).astype(np.int64) >> 8 & 31,
    )
    last = (lane & segment) | (clamp & ~segment)
    first = lane & segment
    source = {"up": lane - b, "down": lane + b, "bfly": lane ^ b, "idx": first | (b & ~segment)}[mode]
    valid = source >= last if mode == "up" else source <= last
    return np.where(valid, source, lane), np.broadcast_to(valid, np.shape(lane)).copy()
