"""The interpreter itself: results of instructions, and every kind of failure by its name."""

from __future__ import annotations

import numpy as np
import pytest

from ptx.interpreter import errors
from ptx.interpreter.harness import Buffer, run

_REGISTERS = ".reg .pred %p<9>; .reg .b16 %rs<9>; .reg .b32 %r<40>; .reg .f32 %f<9>; .reg .b64 %rd<20>;"
_OWN = """
    ld.param.u64 %rd1, [a];
    ld.param.u64 %rd2, [b];
    mov.u32 %r1, %tid.x;
    mov.u32 %r2, %ctaid.x;
    mov.u32 %r3, %ntid.x;
    mad.lo.s32 %r4, %r2, %r3, %r1;
    mul.wide.u32 %rd3, %r4, 4;
    add.s64 %rd4, %rd1, %rd3;
    add.s64 %rd5, %rd2, %rd3;
"""


def program(body, shared=0):
    memory = f".shared .align 4 .b8 tile[{shared}];" if shared else ""
    return f"{memory} .visible .entry k(.param .u64 a, .param .u64 b) {{ {_REGISTERS} {_OWN} {body} ret; }}"


def apply(body, values, dtype=np.uint32):
    """Return the result of ``%r5 -> %r6`` for each value."""
    values = np.asarray(values, dtype)
    values = np.resize(values, -(-values.size // 32) * 32)
    out = np.zeros(values.size, np.uint32)
    text = program(f"ld.global.u32 %r5, [%rd4]; {body} st.global.u32 [%rd5], %r6;")
    run(text, values.size // 32, values.view(np.uint32).copy(), out, block=32)
    return out


NUMBERS = np.array([0, 1, 2, 7, 31, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1, 0x12345678, 0xDEADBEEF], np.uint32)


def _signed(value):
    return int(np.uint32(value).view(np.int32))


@pytest.mark.parametrize(
    ("body", "rule"),
    [
        ("add.s32 %r6, %r5, 7;", lambda a: a + 7),
        ("sub.s32 %r6, 7, %r5;", lambda a: 7 - a),
        ("mul.lo.s32 %r6, %r5, %r5;", lambda a: a * a),
        ("mul.hi.u32 %r6, %r5, %r5;", lambda a: (a * a) >> 32),
        ("mul.hi.s32 %r6, %r5, %r5;", lambda a: (_signed(a) ** 2) >> 32),
        ("div.s32 %r6, %r5, -3;", lambda a: -(abs(_signed(a)) // 3) * (1 if _signed(a) >= 0 else -1)),
        ("rem.u32 %r6, %r5, 10;", lambda a: a % 10),
        ("div.u32 %r6, %r5, 10;", lambda a: a // 10),
        ("min.s32 %r6, %r5, 9;", lambda a: min(_signed(a), 9)),
        ("max.u32 %r6, %r5, 9;", lambda a: max(a, 9)),
        ("abs.s32 %r6, %r5;", lambda a: abs(_signed(a))),
        ("shl.b32 %r6, %r5, 4;", lambda a: a << 4),
        ("shl.b32 %r6, 1, %r5;", lambda a: 1 << a if a < 32 else 0),
        ("shr.u32 %r6, %r5, 33;", lambda a: 0),
        ("shr.s32 %r6, %r5, 33;", lambda a: -1 if _signed(a) < 0 else 0),
        ("popc.b32 %r6, %r5;", lambda a: bin(a).count("1")),
        ("clz.b32 %r6, %r5;", lambda a: 32 - a.bit_length()),
        ("brev.b32 %r6, %r5;", lambda a: int(f"{a:032b}"[::-1], 2)),
        ("bfind.shiftamt.u32 %r6, %r5;", lambda a: 32 - a.bit_length() if a else 2**32 - 1),
        ("bfind.u32 %r6, %r5;", lambda a: a.bit_length() - 1),
        ("bfe.u32 %r6, %r5, 4, 8;", lambda a: (a >> 4) & 255),
        ("bfe.s32 %r6, %r5, 4, 8;", lambda a: ((a >> 4) & 255) - 256 * ((a >> 11) & 1)),
        ("bfi.b32 %r6, %r5, 0x11111111, 8, 4;", lambda a: 0x11111011 | (a & 15) << 8),
        ("prmt.b32 %r6, %r5, 0, 0x0123;", lambda a: int.from_bytes(a.to_bytes(4, "little"), "big")),
        ("lop3.b32 %r6, %r5, 0xF0F0F0F0, 0xCCCCCCCC, 0x96;", lambda a: a ^ 0xF0F0F0F0 ^ 0xCCCCCCCC),
        ("shf.l.wrap.b32 %r6, %r5, %r5, 9;", lambda a: a << 9 | a >> 23),
        ("dp4a.u32.u32 %r6, %r5, 0x01020304, 5;", lambda a: 5 + sum((a >> 8 * k & 255) * (4 - k) for k in range(4))),
        ("dp2a.lo.u32.u32 %r6, %r5, 0x01020304, 5;", lambda a: 5 + (a & 65535) * 4 + (a >> 16) * 3),
        ("setp.lt.s32 %p1, %r5, 5; selp.b32 %r6, 1, 0, %p1;", lambda a: int(_signed(a) < 5)),
        ("setp.ge.u32 %p1, %r5, 5; selp.b32 %r6, 1, 0, %p1;", lambda a: int(a >= 5)),
        ("cvt.s32.s8 %r6, %r5;", lambda a: (a & 255) - 256 * (a >> 7 & 1)),
        ("cvt.sat.u8.u32 %r6, %r5;", lambda a: min(a, 255)),
        ("cvt.u16.u32 %rs1, %r5; cvt.u32.u16 %r6, %rs1;", lambda a: a & 65535),
        ("mov.b32 {%rs1, %rs2}, %r5; mov.b32 %r6, {%rs2, %rs1};", lambda a: a >> 16 | a << 16),
        ("mul.wide.u32 %rd6, %r5, 3; cvt.u32.u64 %r6, %rd6;", lambda a: 3 * a),
        ("mov.u32 %r6, 1; setp.eq.s32 %p1, %r5, 7; @%p1 add.s32 %r6, %r6, 4;", lambda a: 5 if a == 7 else 1),
    ],
    ids=lambda value: value.split("%")[0].strip() if isinstance(value, str) else "",
)
def test_whole_numbers(body, rule):
    want = [rule(int(value)) & 0xFFFFFFFF for value in NUMBERS]
    np.testing.assert_array_equal(apply(body, NUMBERS)[: NUMBERS.size], want)


def test_fma_rounds_once():
    rng = np.random.default_rng(0)
    values = rng.standard_normal(4096).astype(np.float32)
    got = apply("mov.b32 %f1, %r5; fma.rn.f32 %f2, %f1, %f1, 0fBF800001; mov.b32 %r6, %f2;", values, np.float32).view(
        np.float32
    )
    from fractions import Fraction

    minus = np.uint32(0xBF800001).view(np.float32)
    for value, result in zip(values[:500], got[:500], strict=True):
        exact = Fraction(float(value)) ** 2 + Fraction(float(minus))
        below, above = np.nextafter(result, np.float32(-np.inf)), np.nextafter(result, np.float32(np.inf))
        error = abs(Fraction(float(result)) - exact)
        assert error <= min(abs(Fraction(float(near)) - exact) for near in (below, above))


def test_comparisons_with_nan():
    values = np.array([np.nan, 1.0, -1.0], np.float32)
    for how, want in (("lt", [0, 0, 1]), ("ltu", [1, 0, 1]), ("ne", [0, 1, 1]), ("neu", [1, 1, 1]), ("nan", [1, 0, 0])):
        body = f"mov.b32 %f1, %r5; setp.{how}.f32 %p1, %f1, 0f00000000; selp.b32 %r6, 1, 0, %p1;"
        np.testing.assert_array_equal(apply(body, values, np.float32)[:3], want)


def test_floats_to_integers_round_and_saturate():
    values = np.array([0.5, 1.5, -2.5, 3e9, -3e9, np.nan], np.float32)
    got = apply("mov.b32 %f1, %r5; cvt.rni.s32.f32 %r6, %f1;", values, np.float32)[:6].view(np.int32)
    np.testing.assert_array_equal(got, [0, 2, -2, 2**31 - 1, -(2**31), 0])


@pytest.mark.parametrize("seed", [None, 1, 2])
def test_loops_of_different_length_meet_again(seed):
    body = """
        mov.u32 %r6, 0; mov.u32 %r7, 0;
        again: add.s32 %r6, %r6, %r7; add.s32 %r7, %r7, 1; setp.le.u32 %p1, %r7, %r1; @%p1 bra again;
        st.global.u32 [%rd5], %r6;
    """
    out = np.zeros(128, np.uint32)
    run(program(body), 2, np.zeros(128, np.uint32), out, block=64, seed=seed)
    np.testing.assert_array_equal(out, np.tile(np.arange(64) * (np.arange(64) + 1) // 2, 2))


@pytest.mark.parametrize("seed", [None, 3])
@pytest.mark.parametrize(
    ("operation", "want"),
    [
        ("shfl.sync.up.b32 %r6|%p1, %r1, 1, 0, -1;", lambda lane: max(lane - 1, 0)),
        ("shfl.sync.down.b32 %r6|%p1, %r1, 3, 31, -1;", lambda lane: lane + 3 if lane + 3 < 32 else lane),
        ("shfl.sync.bfly.b32 %r6|%p1, %r1, 5, 31, -1;", lambda lane: lane ^ 5),
        ("shfl.sync.idx.b32 %r6|%p1, %r1, 9, 31, -1;", lambda lane: 9),
        ("shfl.sync.idx.b32 %r6|%p1, %r1, %r1, 31, -1;", lambda lane: lane),
        ("setp.gt.u32 %p2, %r1, 29; vote.sync.ballot.b32 %r6, %p2, -1;", lambda lane: 0xC0000000),
        ("redux.sync.add.s32 %r6, %r1, -1;", lambda lane: 496),
    ],
)
def test_lanes_of_a_warp(operation, want, seed):
    out = np.zeros(32, np.uint32)
    run(program(f"{operation} st.global.u32 [%rd5], %r6;"), 1, out.copy(), out, block=32, seed=seed)
    np.testing.assert_array_equal(out, [want(lane) for lane in range(32)])


@pytest.mark.parametrize("seed", [None, 1])
def test_shuffle_of_half_a_warp(seed):
    body = """
        mov.u32 %r6, 77; setp.gt.u32 %p1, %r1, 15; @%p1 bra end;
        shfl.sync.bfly.b32 %r6|%p2, %r1, 1, 31, 0xFFFF;
        end: st.global.u32 [%rd5], %r6;
    """
    out = np.zeros(32, np.uint32)
    run(program(body), 1, out.copy(), out, block=32, seed=seed)
    np.testing.assert_array_equal(out, [lane ^ 1 if lane < 16 else 77 for lane in range(32)])


@pytest.mark.parametrize("seed", [None, 1, 2])
def test_atomics_count_and_return_what_was(seed):
    values, out = np.zeros(128, np.uint32), np.zeros(128, np.uint32)
    run(program("atom.global.add.u32 %r6, [%rd1], 1; st.global.u32 [%rd5], %r6;"), 2, values, out, block=64, seed=seed)
    assert values[0] == 128
    np.testing.assert_array_equal(np.sort(out), np.arange(128))


_SHARED = "mul.wide.u32 %rd6, %r1, 4; mov.u64 %rd7, tile; add.s64 %rd8, %rd7, %rd6; st.shared.u32 [%rd8], %r1;"
_NEIGHBOUR = "xor.b32 %r7, %r1, 1; mul.wide.u32 %rd9, %r7, 4; add.s64 %rd10, %rd7, %rd9; ld.shared.u32 %r6, [%rd10];"
_OTHER_WARP = _NEIGHBOUR.replace("1;", "32;", 1)
_STORE = "st.global.u32 [%rd5], %r6;"


@pytest.mark.parametrize("seed", [None, 1, 2])
@pytest.mark.parametrize(
    ("sync", "read", "fine"),
    [
        ("bar.sync 0;", _OTHER_WARP, True),
        ("", _OTHER_WARP, False),
        ("bar.warp.sync -1;", _OTHER_WARP, False),
        ("bar.warp.sync -1;", _NEIGHBOUR, True),
        ("", _NEIGHBOUR, False),
        ("shfl.sync.bfly.b32 %r8|%p1, %r1, 1, 31, -1;", _NEIGHBOUR, False),
    ],
)
def test_what_orders_shared_memory(sync, read, fine, seed):
    text = program(_SHARED + sync + read + _STORE, shared=256)
    out = np.zeros(128, np.uint32)
    if fine:
        run(text, 2, out.copy(), out, block=64, seed=seed)
        np.testing.assert_array_equal(out, np.tile(np.arange(64) ^ (32 if read == _OTHER_WARP else 1), 2))
    else:
        with pytest.raises(errors.Race if seed is None else (errors.Race, errors.Uninitialised)):
            run(text, 2, out.copy(), out, block=64, seed=seed)


@pytest.mark.parametrize(
    ("body", "error"),
    [
        ("st.global.u32 [%rd5+4], %r1;", errors.OutOfBounds),
        ("ld.global.u32 %r6, [%rd4+-4];", errors.OutOfBounds),
        ("st.global.u32 [%rd2+2], %r1;", errors.Misaligned),
        ("st.global.u32 [%rd2], %r1;", errors.Race),
        ("ld.global.u32 %r6, [%rd2]; st.global.u32 [%rd5], %r6;", errors.Race),
        ("atom.global.add.u32 %r6, [%rd2], 1; ld.global.u32 %r7, [%rd2];", errors.Race),
        ("setp.gt.u32 %p1, %r1, 15; @%p1 ret; shfl.sync.up.b32 %r6|%p2, %r1, 1, 0, -1;", errors.BadShuffle),
        ("setp.gt.u32 %p1, %r1, 15; @%p1 bra o; shfl.sync.up.b32 %r6|%p2, %r1, 1, 0, -1; o: ret;", errors.BadShuffle),
        ("shfl.sync.up.b32 %r6|%p2, %r1, 1, 0, 0xFFFF;", errors.BadShuffle),
        ("setp.gt.u32 %p1, %r1, 15; @%p1 ret; bar.sync 0;", errors.DivergentBarrier),
        ("setp.gt.u32 %p1, %r1, 40; @%p1 bra o; bar.sync 0; ret; o: bar.sync 0;", errors.DivergentBarrier),
        ("setp.gt.u32 %p1, %r1, 9; @%p1 bra o; bar.warp.sync -1; ret; o: bar.sync 0;", errors.Deadlock),
        ("o: bra o;", errors.Deadlock),
        ("trap;", errors.Trap),
        ("add.rz.f32 %f1, %f2, %f3;", errors.UnknownInstruction),
        ("vmin4.u32.u32.u32 %r6, %r1, %r1, %r1;", errors.UnknownInstruction),
    ],
)
def test_failures(body, error):
    values = np.zeros(128, np.uint32)
    with pytest.raises(error):
        run(program(body), 2, values, values.copy(), block=64, max_runs=1000)


def test_races_between_blocks_only():
    body = "mul.wide.u32 %rd6, %r1, 4; add.s64 %rd7, %rd2, %rd6; st.global.u32 [%rd7], %r1;"
    out = np.zeros(64, np.uint32)
    run(program(body), 1, out.copy(), out, block=64)
    with pytest.raises(errors.Race, match="at once"):
        run(program(body), 2, out.copy(), out, block=64)


def test_races_of_accesses_of_different_sizes():
    body = "cvt.u64.u32 %rd6, %r4; add.s64 %rd7, %rd2, %rd6; st.global.u8 [%rd7], %r1; ld.global.u32 %r6, [%rd2+60];"
    with pytest.raises(errors.Race):
        run(program(body), 2, np.zeros(64, np.uint8), np.zeros(64, np.uint8), block=32)


def test_memory_that_nobody_wrote():
    out = np.zeros(64, np.uint32)
    with pytest.raises(errors.Uninitialised):
        run(program("ld.global.u32 %r6, [%rd4];"), 1, Buffer(64, np.uint32), out, block=64)
    with pytest.raises(errors.Uninitialised, match="shared"):
        run(program("ld.shared.u32 %r6, [tile];", shared=16), 1, out, out.copy(), block=32)
    filled = Buffer(64, np.uint32)
    run(program("st.global.u32 [%rd5], %r4;"), 1, out, filled, block=64)
    run(program("ld.global.u32 %r6, [%rd4]; st.global.u32 [%rd5], %r6;"), 1, filled, out, block=64)
    np.testing.assert_array_equal(out, np.arange(64))


def test_slices_of_an_array_keep_their_bounds_unless_they_overlap():
    body = "ld.global.u32 %r6, [%rd4+128]; st.global.u32 [%rd5], %r6;"
    whole, out = np.arange(64, dtype=np.uint32), np.zeros(32, np.uint32)
    run(program(body), 1, whole, out, block=32)
    np.testing.assert_array_equal(out, np.arange(32, 64))
    with pytest.raises(errors.OutOfBounds):
        run(program(body), 1, whole[:32], out, block=32)
    both = np.arange(64, dtype=np.uint32)
    run(program("ld.global.u32 %r6, [%rd4]; st.global.u32 [%rd5+128], %r6;"), 1, both[:32], both, block=32)
    np.testing.assert_array_equal(both[32:], np.arange(32))
