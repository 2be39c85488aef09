"""A Hub that is a folder."""

import shutil
from pathlib import Path
from types import SimpleNamespace

from huggingface_hub import CommitOperationDelete


class FakeHub:
    """Keeps commits in a folder and records its calls."""

    def __init__(self, folder: Path, fail: Exception | None = None):
        self.folder, self.fail, self.asked, self.tags = folder, fail, [], {}

    def create_repo(self, repo, *, repo_type, private, exist_ok):
        self.asked.append(("create_repo", repo, repo_type, private, exist_ok))
        if self.fail:
            raise self.fail

    def create_commit(self, repo, operations, *, commit_message, repo_type):
        for operation in operations:
            if isinstance(operation, CommitOperationDelete):
                (self.folder / operation.path_in_repo).unlink()
                continue
            target = self.folder / operation.path_in_repo
            target.parent.mkdir(parents=True, exist_ok=True)
            with operation.as_file() as content:
                target.write_bytes(content.read())
        self.asked.append(("create_commit", repo, commit_message, repo_type))
        return SimpleNamespace(oid=f"commit{len(self.asked)}", commit_url=f"https://hub/{repo}")

    def list_repo_files(self, repo, *, repo_type):
        files = (path for path in self.folder.rglob("*") if path.is_file())
        return [path.relative_to(self.folder).as_posix() for path in files]

    def list_repo_refs(self, repo, *, repo_type):
        return SimpleNamespace(tags=[SimpleNamespace(name=name) for name in self.tags])

    def delete_tag(self, repo, *, tag, repo_type):
        del self.tags[tag]

    def create_tag(self, repo, *, tag, revision, repo_type):
        assert tag not in self.tags
        self.tags[tag] = revision

    def snapshot_download(self, repo, *, repo_type, revision, local_dir, allow_patterns):
        self.asked.append(("snapshot_download", repo, repo_type, revision, tuple(allow_patterns)))
        if self.fail:
            raise self.fail
        shutil.copytree(self.folder, local_dir, dirs_exist_ok=True)
        (local_dir / ".cache/huggingface").mkdir(parents=True)
