"""Programs in a temporary folder: time limits, errors, and nothing left behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.planted import imported_from, plant
from uavmec_jax.errors import TrafficError
from uavmec_jax.traffic.workspace import Workspace, first_error


def python(code):
    return [sys.executable, "-c", code]


def test_programs_run_in_a_folder_that_is_removed():
    with Workspace() as workspace:
        folder = workspace.folder
        assert workspace.run("p", python("open('x', 'w').write('y'); print('done')"), limit_s=20) == "done\n"
        assert (folder / "x").read_text() == "y"
        printed = workspace.run("p", python("import os; print(os.environ['GIVEN'])"), limit_s=20, env={"GIVEN": "here"})
        assert printed == "here\n"
    assert not folder.exists()


def test_failures_report_the_first_error():
    lines = ("Warning: a", "Error: the road is cut", "Error: No edges loaded.", "Quitting (on error).")
    code = f"import sys; sys.stderr.write({chr(10).join(lines)!r}); sys.exit(1)"
    with Workspace() as workspace:
        with pytest.raises(TrafficError, match=r"^netconvert: the road is cut$"):
            workspace.run("netconvert", python(code), limit_s=20)
        with pytest.raises(TrafficError, match=r"^p: ended with exit code 3$"):
            workspace.run("p", python("raise SystemExit(3)"), limit_s=20)
        with pytest.raises(TrafficError, match=r"^p: ended with exit code -9$"):
            workspace.run("p", python("import os; os.kill(os.getpid(), 9)"), limit_s=20)
        with pytest.raises(TrafficError, match=r"p: did not end within its limit of 0.2 s and was stopped"):
            workspace.run("p", python("import time; time.sleep(60)"), limit_s=0.2)
        folder = workspace.folder
    assert not folder.exists()
    assert first_error("one\ntwo") == "two"
    assert first_error("") == ""
    assert first_error("Error: no such road\nError: Process Error") == "no such road"


def test_it_works_on_without_its_watchdog():
    with Workspace() as workspace:
        workspace._watchdog.kill()
        workspace._watchdog.wait()
        assert workspace.run("p", python("print(1)"), limit_s=20) == "1\n"
        folder = workspace.folder
    assert not folder.exists()


def test_planted_modules_do_not_run_in_the_watchdog(tmp_path, monkeypatch):
    monkeypatch.chdir(plant(tmp_path))
    with Workspace() as workspace:
        assert workspace.run("p", [sys.executable, "-I", "-c", "print(1)"], limit_s=20) == "1\n"
        process = workspace._watchdog
    assert process.returncode == 0
    assert imported_from(tmp_path) == []


def test_nothing_is_started_after_a_stop():
    with Workspace() as workspace:
        workspace.stop()
        with pytest.raises(TrafficError, match="stopped before it was started"):
            workspace.run("p", python("1"), limit_s=20)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT], ids=lambda how: how.name)
def test_nothing_is_left_behind_when_killed(tmp_path, how):
    code = f"""
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell makes its background processes ignore
from pathlib import Path
from uavmec_jax.traffic.workspace import Workspace
sleeper = "import os, time; open('pid', 'w').write(str(os.getpid())); os.rename('pid', '{tmp_path}/pid'); time.sleep(600)"
with Workspace() as workspace:
    Path("{tmp_path}/folder").write_text(str(workspace.folder))
    workspace.run("p", [sys.executable, "-c", sleeper], limit_s=600)
"""
    process = subprocess.Popen(python(code), stderr=subprocess.DEVNULL)
    wait_for((tmp_path / "pid").exists)
    worker, folder = int((tmp_path / "pid").read_text()), Path((tmp_path / "folder").read_text())
    assert folder.is_dir()
    process.send_signal(how)
    process.wait(timeout=20)
    wait_for(lambda: not folder.exists())
    wait_for(lambda: not alive(worker))


def alive(pid):
    """Return whether a process runs; a zombie does not."""
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_for(condition, seconds=20):
    for _ in range(int(seconds / 0.05)):
        if condition():
            return
        time.sleep(0.05)
    raise AssertionError("did not happen")
