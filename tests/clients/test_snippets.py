"""The code of the docs that needs a client, where that client is."""

import pytest

from tests.clients.conftest import collect_ignore
from tests.test_docs import PAGES, blocks, execute

pytestmark = pytest.mark.clients

CASES = [(page, block) for page in PAGES for block in blocks(page, "python") if block.client is not None]
HERE = [(page, block) for page, block in CASES if f"test_{block.client}.py" not in collect_ignore]


def test_there_is_such_code():
    assert {block.client for _, block in CASES} == {"gymnax", "sb3"}


@pytest.mark.parametrize(("page", "block"), HERE, ids=[f"{page}:{block.line}" for page, block in HERE])
def test_code_runs(page, block, tmp_path, monkeypatch):
    execute(page, [block], tmp_path, monkeypatch)
