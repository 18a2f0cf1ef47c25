"""Runs in object stores: what is refused, in one line, before anything is written."""

import boto3
import moto.settings
import pytest
import s3fs
from click.testing import CliRunner

import uavmec_jax as um
from tests.runs.object_stores import BUCKET, s3_server
from tests.runs.processes import TINY
from uavmec_jax.cli import main
from uavmec_jax.errors import PolicyError, StudyError
from uavmec_jax.files.locations import to_path
from uavmec_jax.files.writing import write_text
from uavmec_jax.runs.options import RunOptions
from uavmec_jax.runs.run import run_study
from uavmec_jax.studies.results_files import load_weights
from uavmec_jax.studies.study import parse_study

STUDY = parse_study(TINY, "tiny")
server = pytest.fixture(scope="module")(s3_server)


def test_a_folder_made_in_a_console_takes_a_run(server):
    """Consoles of stores show a folder by an empty object whose name ends with a slash."""
    boto3.client("s3").put_object(Bucket=BUCKET, Key="empty/", Body=b"")
    with pytest.raises(StudyError, match="cannot be found as a test"):
        run_study(STUDY, f"s3://{BUCKET}/empty", on_plan=_stop)
    write_text(to_path(f"s3://{BUCKET}/full/notes"), "")
    with pytest.raises(StudyError, match=rf"^s3://{BUCKET}/full: exists and is not an empty folder"):
        run_study(STUDY, f"s3://{BUCKET}/full", on_plan=_stop)


def _stop(plan):
    raise StudyError("cannot be found as a test")


@pytest.mark.parametrize(
    ("arguments", "changes", "line"),
    [
        (["run", "tiny.toml", "--out", "s3://no-such-bucket/run"], {}, "The specified bucket does not exist"),
        (["resume", "s3://no-such-bucket/run"], {}, "holds no run that can be resumed"),
        (["status", f"s3://{BUCKET}/nothing"], {}, "holds no run that can be resumed"),
        (["show", f"s3://{BUCKET}/nothing"], {}, "holds no run (run.json is missing)"),
        (["evaluate", f"s3://{BUCKET}/nothing"], {}, "neither a file nor a policy by name"),
        (["run", "tiny.toml", "--out", "s3://Bad!/run"], {}, 'Invalid bucket name "Bad!"'),
        (
            ["run", "tiny.toml", "--out", f"s3://{BUCKET}/run"],
            {"AWS_ENDPOINT_URL": "http://127.0.0.1:9"},
            "Could not connect",
        ),
        (["evaluate", f"s3://{BUCKET}/run"], {"AWS_ENDPOINT_URL": "http://127.0.0.1:9"}, "Could not connect"),
        (["run", "tiny.toml", "--out", "nothing://a/run"], {}, "nothing://a/run: Unsupported filesystem: 'nothing'"),
        (["run", "tiny.toml", "--out", f"s3://{BUCKET}/run", "--tensorboard"], {}, "--tensorboard writes files beside"),
        (["run", "tiny.toml", "--out", "memory://a/run", "--ray", "local"], {}, "the memory of one process"),
        (["search", "dqn", "--out", f"s3://{BUCKET}/search"], {}, "is in an object store, where only runs can be"),
        (["plan", "--out", f"s3://{BUCKET}/plan"], {}, "is in an object store, where only runs can be"),
    ],
)
def test_what_cannot_be_done_is_one_line(server, tmp_path, monkeypatch, arguments, changes, line):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    (tmp_path / "tiny.toml").write_text(TINY)
    for name, value in changes.items():
        monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()  # its sessions have the former settings
    done = CliRunner().invoke(main, arguments)
    monkeypatch.undo()
    s3fs.S3FileSystem.clear_instance_cache()
    assert done.exit_code == 2, done.output
    assert done.stderr.startswith("uavmec: ")
    assert done.stderr.count("\n") == 1
    assert line in done.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["tiny.toml"]
    assert boto3.client("s3").list_objects_v2(Bucket=BUCKET, Prefix="run/")["KeyCount"] == 0


@pytest.fixture
def strict(server, monkeypatch):
    """The server, which now checks who asks, and knows nobody."""
    s3fs.S3FileSystem.clear_instance_cache()
    monkeypatch.setattr(moto.settings, "INITIAL_NO_AUTH_ACTION_COUNT", 0.0)
    yield
    s3fs.S3FileSystem.clear_instance_cache()


@pytest.mark.parametrize("keys", [True, False])
def test_without_credentials(strict, monkeypatch, keys):
    if not keys:
        monkeypatch.delenv("AWS_ACCESS_KEY_ID")
        monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    for call in (um.load_results, um.runs.run_status, um.runs.resume_run, lambda url: run_study(STUDY, url)):
        with pytest.raises(
            StudyError, match=rf"^s3://{BUCKET}/run: .*(Forbidden|Denied|not exist|credentials)"
        ) as refused:
            call(f"s3://{BUCKET}/run")
        assert "\n" not in str(refused.value)


def test_what_python_callers_are_told(server):
    for load, error in ((um.load_results, StudyError), (load_weights, PolicyError), (um.load_policy, PolicyError)):
        with pytest.raises(error, match=rf"^s3://{BUCKET}/nothing[:/]"):
            load(f"s3://{BUCKET}/nothing")
    with pytest.raises(StudyError, match=r"^s3://no-such-bucket/run: The specified bucket does not exist$"):
        run_study(STUDY, "s3://no-such-bucket/run")
    with pytest.raises(StudyError, match="--tensorboard"):
        run_study(STUDY, f"s3://{BUCKET}/run", options=RunOptions(tensorboard=True))
