"""How files are replaced: through links, with their permissions, and without rests of killed runs."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
import threading

import pytest

from stereokit import io
from stereokit.errors import FileError
from stereokit.io import atomic

POSIX = pytest.mark.skipif(os.name != "posix", reason="of POSIX file systems")


@POSIX
def test_a_link_stays_and_what_it_points_to_is_replaced(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "map.bin").write_bytes(b"old")
    (tmp_path / "link.bin").symlink_to("real/map.bin")
    (tmp_path / "chain.bin").symlink_to("link.bin")
    (tmp_path / "dangling.bin").symlink_to("real/new.bin")
    for name, there in (("link.bin", "map.bin"), ("chain.bin", "map.bin"), ("dangling.bin", "new.bin")):
        io.write_bytes(tmp_path / name, name.encode())
        assert (tmp_path / name).is_symlink()
        assert (tmp_path / "real" / there).read_bytes() == name.encode()
    assert sorted(os.listdir(tmp_path / "real")) == ["map.bin", "new.bin"]
    assert sorted(os.listdir(tmp_path)) == ["chain.bin", "dangling.bin", "link.bin", "real"]
    (tmp_path / "lost.bin").symlink_to("nowhere/map.bin")
    for write in (lambda: io.write_bytes(tmp_path / "lost.bin", b""), lambda: io.check_output(tmp_path / "lost.bin")):
        with pytest.raises(FileError, match="nowhere"):
            write()


@POSIX
def test_permissions_stay_and_new_files_follow_the_mask(tmp_path):
    path = tmp_path / "a.bin"
    before = os.umask(0o027)
    try:
        io.write_bytes(path, b"1")
        assert stat.S_IMODE(path.stat().st_mode) == 0o640
        for mode in (0o600, 0o664, 0o755):
            path.chmod(mode)
            io.write_bytes(path, b"2")
            assert stat.S_IMODE(path.stat().st_mode) == mode
    finally:
        os.umask(before)


@POSIX
def test_a_pipe_is_written_to(tmp_path):
    pipe = tmp_path / "map.bin"
    os.mkfifo(pipe)
    with pytest.raises(FileError, match="nobody reads"):
        io.write_bytes(pipe, b"lost")
    got = []
    reader = threading.Thread(target=lambda: got.append(pipe.read_bytes()))
    reader.start()
    content = bytes(range(256)) * 4096  # more than a pipe holds
    while reader.is_alive() and not got:
        try:
            io.write_bytes(pipe, content)
            break
        except FileError:  # the reader has not come that far
            continue
    reader.join()
    assert got == [content] and stat.S_ISFIFO(pipe.stat().st_mode) and os.listdir(tmp_path) == ["map.bin"]
    io.write_bytes(os.devnull, b"gone")
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode)


def test_a_folder_is_refused_and_left_as_it_is(tmp_path):
    (tmp_path / "a.bin").mkdir()
    with pytest.raises(FileError, match="cannot write"):
        io.write_bytes(tmp_path / "a.bin", b"x")
    assert os.listdir(tmp_path) == ["a.bin"]


@POSIX
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_a_killed_run_leaves_nothing_for_longer_than_the_next(number, tmp_path):
    if signal.getsignal(number) is signal.SIG_IGN:
        pytest.skip("the signal is ignored here, as under nohup")
    script = tmp_path / "hold.py"
    script.write_text(
        """
import sys, time
from stereokit import io
from stereokit.cli import app

def hold(path: str) -> None:
    with io.replacing(path) as temporary:
        temporary.write_bytes(b"half")
        print("ready", flush=True)
        time.sleep(600)

app.app.command("hold")(hold)
app.main()
"""
    )
    folder = tmp_path / "maps"
    folder.mkdir()
    (folder / "map.bin").write_bytes(b"old")
    (folder / ".0123456789abcdef.tmp").write_bytes(b"not ours")
    with subprocess.Popen(
        [sys.executable, script, "hold", folder / "map.bin"], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout.readline() == "ready\n"
            names = [name for name in os.listdir(folder) if name.startswith(".stereokit-")]
            assert len(names) == 1
            atomic._clean_folders.clear()
            io.write_bytes(folder / "other.bin", b"")  # what is being written stays
            assert names[0] in os.listdir(folder)
            process.send_signal(number)
            assert process.wait(60) == -number
        finally:
            process.kill()
    rest = {".0123456789abcdef.tmp", "map.bin", "other.bin"}
    assert set(os.listdir(folder)) == rest | (set(names) if number == signal.SIGKILL else set())
    assert (folder / "map.bin").read_bytes() == b"old"
    atomic._clean_folders.clear()
    io.write_bytes(folder / "map.bin", b"new")
    assert set(os.listdir(folder)) == rest and (folder / "map.bin").read_bytes() == b"new"
