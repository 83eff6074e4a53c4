"""What file system a folder lies on."""

from __future__ import annotations

import os
from pathlib import Path

OVER_A_NETWORK = {
    "nfs", "nfs4", "cifs", "smb", "smb2", "smb3", "smbfs", "afs", "ceph", "lustre", "gpfs", "beegfs",
    "glusterfs", "9p", "ncpfs", "pvfs2", "orangefs", "fuse.sshfs", "fuse.glusterfs", "fuse.ceph",
    "fuse.juicefs", "fuse.s3fs", "davfs",
}  # fmt: skip
MOUNTS = Path("/proc/self/mountinfo")


def is_local(folder: Path) -> bool:
    """Whether processes that use the folder share memory: False on a network file system, and where
    the system does not tell."""
    try:
        lines = MOUNTS.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
        here = os.fsencode(folder.resolve())
    except OSError:
        return False
    best, kind = -1, ""
    for line in lines:
        left, _, right = line.partition(" - ")
        mount = _unescaped(left.split()[4])
        if (here + b"/").startswith(mount.rstrip(b"/") + b"/") and len(mount) >= best:
            best, kind = len(mount), right.split()[0]
    return bool(kind) and kind not in OVER_A_NETWORK


def _unescaped(path: str) -> bytes:
    """Blanks and the like are written as octal numbers there."""
    return os.fsencode(path).decode("unicode_escape").encode("latin-1")
