"""Cache of traced programs in a directory, for later runs.

JAX's cache finds compiled programs by their traces. Tracing takes as long as everything else, so
another directory holds the traces, found by all that tracing depends on.
"""

import contextlib
import functools
import hashlib
import os
import pickle
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
_SUFFIX = f"-{32 * '[0-9a-f]'}.stablehlo"


class Traced(NamedTuple):
    """A traced program that takes and returns flat leaves, and the structure of its results.

    `jax.export` could write structures itself, but only of classes that are registered with it,
    once per process and name.
    """

    flat: export.Exported
    structure: object

    def __call__(self, *args: PyTree) -> PyTree:
        """Calls the program with arguments of the structure with which it was traced."""
        return jax.tree.unflatten(self.structure, self.flat.call(*jax.tree.leaves(args)))


def trace(function: Function, args: PyTree) -> Traced:
    """Traces a program and lowers it, apart from whatever calls it.

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


def shapes_of(args: PyTree) -> PyTree[jax.ShapeDtypeStruct]:
    """Shapes and dtypes of arguments; Python numbers count as JAX arrays."""
    return jax.eval_shape(lambda args: args, args)


class Kept:
    """Cache of traced programs in the directory `path`."""

    def __init__(self, directory: Path, *settings: object):
        """Opens the cache, and removes the least recently used programs.

        Args:
          directory: holds the cache, in `traced`.
          *settings: what programs close over outside jaxsense's source; their `repr` differs.

        Raises:
          OSError: if the directory cannot be made, or if other users may write to it: loading a
            program runs it.
        """
        self.path, self._complain = directory / "traced", functools.cache(complain)
        _make_private(self.path)
        self._depends = repr((settings, _surroundings())).encode()
        # Another run may be removing some too.
        with contextlib.suppress(FileNotFoundError):
            ours = [x for x in self.path.glob(f"*{_SUFFIX}") if x.is_file() and not x.is_symlink()]
            for path in sorted(ours, key=lambda path: path.stat().st_mtime)[:-_MAX_KEPT]:
                path.unlink()
            files.remove_unfinished(self.path)

    def find_or_trace(
        self, name: str, function: Function, args: PyTree, closed: object = ()
    ) -> Traced | None:
        """Finds a cached program, or traces and caches it; None if it cannot be exported.

        Its name, its arguments, and what it closes over besides the settings tell it from others. A
        line to standard error says why it cannot be loaded, exported or cached.
        """
        differs = repr((shapes_of(args), closed)).encode()
        digest = hashlib.sha256(self._depends + differs).hexdigest()[:32]
        path, traced = self.path / f"{name}-{digest}.stablehlo", None
        # A run must not end because this one or the next will be slower: a damaged file, a program
        # that calls something which JAX cannot export, a full disk.
        try:
            # A single wrong bit could end the process.
            structure, flat = pickle.loads(files.without_digest(path.read_bytes()))
            traced = Traced(export.deserialize(bytearray(flat)), structure)
            path.touch()
            return traced
        except FileNotFoundError:
            pass
        except Exception as error:
            self._tell(error)
        try:
            traced = trace(function, args)
            content = pickle.dumps((traced.structure, bytes(traced.flat.serialize())))
            files.write_digested(path, content, mode=0o600)
        except Exception as error:
            self._tell(error)
        return traced

    def _tell(self, error: Exception) -> None:
        """Tells once why programs are slower to start than they could be."""
        text = error.strerror if isinstance(error, OSError) else str(error)
        reason = f"{type(error).__name__} {text}".splitlines()[0]
        self._complain(f"jaxsense: {self.path}: a program must be traced again ({reason})")


def use_cache(directory: Path) -> None:
    """Makes JAX cache all compiled programs, also small ones, unless the user has set a cache.

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


def _make_private(path: Path) -> None:
    """Makes a directory private to this user; raises `OSError` if it exists and is not."""
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700, parents=True)
    found = path.lstat()
    is_own = not hasattr(os, "getuid") or found.st_uid == os.getuid()
    if not (stat.S_ISDIR(found.st_mode) and is_own and not found.st_mode & 0o077):
        raise PermissionError(f"{path} must be a directory that you own, with mode 0700")


def _surroundings() -> list[object]:
    """Code, versions, options and devices, on which tracing depends."""
    variables = [(n, x) for n, x in os.environ.items() if n.startswith(("JAX_", "XLA_"))]
    options = [*variables, *((name, str(x)) for name, x in jax.config.values.items())]
    return [
        version.SOURCE,
        version.versions(),
        # Where compiled programs are cached leaves them unchanged.
        sorted((name, x) for name, x in options if "cache" not in name.lower()),
        jax.devices()[0].client.platform_version,
        [(device.platform, device.device_kind) for device in jax.devices()],
    ]
