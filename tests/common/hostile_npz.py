"""Writes .npz files that no writer of ours would: a header that claims any shape, members that unpack to anything."""

import io
import zipfile
from pathlib import Path

from numpy.lib import format as npy

MIB = 1 << 20


def member(shape: tuple[int, ...], data: bytes = b"", dtype: str = "<f8") -> bytes:
    """A member whose header claims a shape, before these bytes."""
    out = io.BytesIO()
    npy.write_array_header_1_0(out, {"descr": dtype, "fortran_order": False, "shape": shape})
    return out.getvalue() + data


def write_members(path: Path, /, **members: bytes) -> Path:
    """A zip file of members of these names."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return path


def write_bomb(path: Path, name: str, mib: int) -> Path:
    """An array of so many MiB of zeros, packed to a thousandth."""
    head = member((mib * MIB // 8,))
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open(f"{name}.npy", "w") as file,
    ):
        file.write(head)
        for _ in range(mib):
            file.write(bytes(MIB))
    return path
