"""The remote as it is in the field: an S3-compatible server, here moto's
on loopback, that knows nothing of this project."""

import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request

import pytest

from tests.nightly.toy_nights import Project

pytest.importorskip(
    "moto", reason="moto is not installed: ./run --group s3 pytest -m slow tests/nightly/test_nightly_s3.py"
)
pytest.importorskip("dvc_s3", reason="dvc-s3 is not installed")


@pytest.fixture
def server(tmp_path):
    """Address of a server with an empty bucket `beadline`."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"http://127.0.0.1:{port}"
    with (tmp_path / "moto.log").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "moto.server", "-p", str(port)], stdout=log, stderr=log
        )
    try:
        for _ in range(120):
            try:
                urllib.request.urlopen(
                    urllib.request.Request(f"{address}/beadline", method="PUT"), timeout=5
                ).close()
                break
            except (urllib.error.URLError, ConnectionError):
                time.sleep(0.5)
        yield address
    finally:
        process.terminate()
        process.wait()


@pytest.mark.slow
def test_a_night_pushes_to_s3_and_a_fresh_clone_has_the_champion_bit_by_bit(server, tmp_path):
    project = Project(tmp_path / "toy").make()
    project.env |= {
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
        "NO_PROXY": "127.0.0.1",
        "no_proxy": "127.0.0.1",
    }
    dvc = (sys.executable, "-m", "dvc")
    project.run(*dvc, "remote", "add", "-q", "-d", "store", "s3://beadline/dvc")
    project.run(*dvc, "remote", "modify", "-q", "store", "endpointurl", server)
    project.set(remote="store")
    project.run("git", "commit", "-qam", "a remote")
    ended = project.night()
    assert ended.returncode == 0 and "is not on the remote" not in ended.stdout, ended
    project.run("git", "clone", "-q", str(project.folder), str(tmp_path / "clone"))
    clone = Project(tmp_path / "clone")
    clone.env = project.env
    assert not os.path.exists(tmp_path / "clone/champion/toy")
    clone.run(*dvc, "pull", "-q")
    assert clone.production() == project.production()
