"""Keeps traced programs, and JAX's compilation cache, in a directory for later runs."""

import contextlib
import functools
import hashlib
import os
import pickle
import re
import stat
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeAlias

import jax
from jax import export
from jaxtyping import PyTree

from jaxsense.run import files, version
from jaxsense.run.output import complain

Function: TypeAlias = Callable[..., PyTree]

_MAX_KEPT = 512  # traced programs; a run has about twenty
_MAX_BYTES = 2**31  # of compiled programs
_FILE = re.compile(r".+-[0-9a-f]{32}\.stablehlo")


class Traced(NamedTuple):
    """A traced program that takes and returns flat leaves, and the structure of its results.

    `jax.export` could write structures itself, but only of classes that are registered with it,
    once per process and name.
    """

    flat: export.Exported
    structure: object

    @property
    def results(self) -> PyTree[jax.ShapeDtypeStruct]:
        """Shapes and dtypes of the results."""
        avals = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in self.flat.out_avals]
        return jax.tree.unflatten(self.structure, avals)

    def __call__(self, *args: PyTree) -> PyTree:
        """Calls the program with arguments of the structure with which it was traced."""
        leaves = self.flat.call(*jax.tree.leaves(args))
        return jax.tree.unflatten(self.structure, leaves)


class Kept:
    """Cache of traced programs in a directory.

    JAX's compilation cache finds compiled programs by their traces. Tracing takes as long as
    everything else, so this directory holds the traces, found by all that tracing depends on.

    Attributes:
      path: the directory of traced programs.
    """

    def __init__(self, directory: Path, *settings: object):
        """Opens the cache, and removes the least recently used programs.

        Args:
          directory: holds the traced programs.
          *settings: everything outside jaxsense's source that programs close over, as values whose
            `repr` tells them apart.

        Raises:
          OSError: if the directory cannot be made, or if other users may write to it: loading a
            program runs it.
        """
        self.path, self._complain = directory / "traced", functools.cache(complain)
        _make_private(self.path)
        self._depends = repr((settings, _surroundings())).encode()
        # Another run may be removing some too.
        with contextlib.suppress(FileNotFoundError):
            self._forget_oldest()

    def _forget_oldest(self) -> None:
        """Removes the least recently used programs, and no other file."""
        ours = [
            path
            for path in self.path.iterdir()
            if _FILE.fullmatch(path.name) and path.is_file() and not path.is_symlink()
        ]
        for path in sorted(ours, key=lambda path: path.stat().st_mtime)[:-_MAX_KEPT]:
            path.unlink(missing_ok=True)
        files.remove_unfinished(self.path)

    def find(self, name: str, args: PyTree) -> Traced | None:
        """Finds a cached program.

        Args:
          name: of the program.
          args: its arguments or their shapes.

        Returns:
          The program; None if its file is missing or, with a line to standard error, damaged.
        """
        path = self._file(name, args)
        try:
            with path.open("rb") as file:
                if not _is_private(os.fstat(file.fileno()), 0o022):
                    raise PermissionError("other users may have written it")
                content = file.read()
            # A single wrong bit could end the process.
            structure, flat = pickle.loads(files.without_digest(content))
            found = Traced(export.deserialize(bytearray(flat)), structure)
            path.touch()
            return found
        except FileNotFoundError:
            return None
        except Exception as error:  # tracing the program again repairs any file
            return self._tell(error)

    def find_or_trace(self, name: str, function: Function, args: PyTree) -> Traced | None:
        """Finds a cached program, or traces and caches a new one.

        Args:
          name: of the program.
          function: what to trace.
          args: its arguments or their shapes.

        Returns:
          The program; None if it cannot be exported. A line to standard error says why it cannot be
          loaded, exported or cached.
        """
        found = self.find(name, args)
        if found is not None:
            return found
        # A run must not end because the next one will be slower: where a program calls something
        # that JAX cannot export, or on a full disk.
        traced = None
        try:
            traced = trace(function, args)
            content = pickle.dumps((traced.structure, bytes(traced.flat.serialize())))
            files.write_digested(self._file(name, args), content, mode=0o600)
        except Exception as error:
            self._tell(error)
        return traced

    def _tell(self, error: Exception) -> None:
        """Tells once why programs are slower to start than they could be."""
        text = error.strerror if isinstance(error, OSError) else str(error)
        reason = f"{type(error).__name__} {text}".splitlines()[0]
        self._complain(f"jaxsense: {self.path}: a program must be traced again ({reason})")

    def _file(self, name: str, args: PyTree) -> Path:
        """The file of a program."""
        shapes = repr(shapes_of(args)).encode()
        digest = hashlib.sha256(self._depends + shapes).hexdigest()[:32]
        return self.path / f"{name}-{digest}.stablehlo"


def trace(function: Function, args: PyTree) -> Traced:
    """Traces a program and lowers it, apart from whatever calls it.

    Args:
      function: what to trace.
      args: its arguments or their shapes.

    Raises:
      NotImplementedError: if it calls something that JAX cannot export, such as the host.
    """
    leaves, structure = jax.tree.flatten(args)
    results: list[object] = []

    def flat(*leaves: jax.Array) -> list[jax.Array]:
        output = function(*jax.tree.unflatten(structure, leaves))
        results.append(jax.tree.structure(output))
        return jax.tree.leaves(output)

    exported = export.export(jax.jit(flat))(*shapes_of(leaves))
    return Traced(exported, results[-1])


def use_cache(directory: Path) -> None:
    """Makes JAX cache all compiled programs, also small ones, unless the user has set a cache.

    Args:
      directory: holds them, in `compiled`.

    Raises:
      OSError: if the directory cannot be made, or if other users may write to it.
    """
    path = directory / "compiled"
    _make_private(path)
    # A cache that cannot be read or written, for example on a full disk, only costs time.
    warnings.filterwarnings("ignore", category=UserWarning, module=r"jax\._src\.compiler")
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_compilation_cache_max_size", _MAX_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def shapes_of(args: PyTree) -> PyTree[jax.ShapeDtypeStruct]:
    """Shapes and dtypes of arguments; Python numbers count as JAX arrays."""
    return jax.eval_shape(lambda args: args, args)


def _make_private(path: Path) -> None:
    """Makes a directory private to this user; raises `OSError` if it exists and is not."""
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700, parents=True)
    found = path.lstat()
    if not (stat.S_ISDIR(found.st_mode) and _is_private(found, 0o077)):
        raise PermissionError(f"{path} must be a directory that you own, with mode 0700")


def _is_private(found: os.stat_result, others: int) -> bool:
    """Whether this user owns a file, and other users have none of the rights `others`."""
    is_own = not hasattr(os, "getuid") or found.st_uid == os.getuid()
    return is_own and found.st_mode & others == 0


def _surroundings() -> list[object]:
    """Code, versions, options and devices, on which tracing depends."""
    variables = [item for item in os.environ.items() if item[0].startswith(("JAX_", "XLA_"))]
    return [
        version.SOURCE,
        version.versions(),
        sorted((name, value) for name, value in variables if not _sets_cache(name)),
        sorted((name, str(x)) for name, x in jax.config.values.items() if not _sets_cache(name)),
        jax.devices()[0].client.platform_version,
        [(device.platform, device.device_kind) for device in jax.devices()],
    ]


def _sets_cache(option: str) -> bool:
    """Whether an option only concerns JAX's cache and leaves programs unchanged."""
    return "cache" in option.lower()
