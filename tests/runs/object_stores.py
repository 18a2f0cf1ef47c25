"""Stores for tests: a server on this machine that speaks the S3 protocol, and one in memory."""

import os
from collections.abc import Iterator

import boto3
import fsspec
import pytest
import s3fs
from moto.server import ThreadedMotoServer

BUCKET = "bucket"


def s3_server() -> Iterator[str]:
    """Yield the address of an S3-compatible server with one bucket; the store's package and all subprocesses use it."""
    moto = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    moto.start()
    address = "http://{}:{}".format(*moto.get_host_and_port())
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {
            "AWS_ENDPOINT_URL": address,
            "AWS_ACCESS_KEY_ID": "test",
            "AWS_SECRET_ACCESS_KEY": "test",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_EC2_METADATA_DISABLED": "true",  # else credentials are looked for in the network
            "AWS_CONFIG_FILE": os.devnull,
            "AWS_SHARED_CREDENTIALS_FILE": os.devnull,
        }.items():
            patch.setenv(name, value)
        boto3.client("s3").create_bucket(Bucket=BUCKET)
        s3fs.S3FileSystem.clear_instance_cache()
        yield address
        s3fs.S3FileSystem.clear_instance_cache()
    moto.stop()


def memory_store() -> Iterator[str]:
    """Yield the URL of a run in the memory of this process."""
    store = fsspec.filesystem("memory")
    store.rm("/", recursive=True)
    yield "memory://tests/run"
    store.rm("/", recursive=True)
