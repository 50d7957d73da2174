"""Collectors in processes of Ray, with errors that give the reason why a worker failed."""

from collections.abc import Iterator
from contextlib import contextmanager
from traceback import clear_frames

from torchrl.collectors import Collector

from torchrl_mcp.training.workers import failure


class RayWorker(Collector):
    """TorchRL's collector in a process of Ray."""

    def __bool__(self) -> bool:
        """Return True, so that Ray can test a worker whose constructor failed.

        By default, Python would call TorchRL's ``__len__``, which counts the remaining batches.
        """
        return True


@contextmanager
def starting() -> Iterator[None]:
    """End Ray's workers if the block, which starts them, fails, and raise an error that gives the reason.

    Raises:
        ChildProcessError: If a worker ends, or fails with an error other than the two below.
        OSError: If the block raises this error.
        ValueError: If the block raises this error.
    """
    from ray.exceptions import RayError

    try:
        yield
    except Exception as error:
        # As soon as no frame refers to the collector, it ends its workers, and Ray itself if the collector started it.
        clear_frames(error.__traceback__)
        if isinstance(error, RayError):
            raise _reason("started", error) from error
        if isinstance(error, (OSError, ValueError)):
            raise
        raise failure("Ray's workers cannot be started", error) from error


@contextmanager
def working() -> Iterator[None]:
    """Raise an error that gives the reason if a worker fails or ends during the block.

    Raises:
        ChildProcessError: If a worker fails or ends.
    """
    from ray.exceptions import RayError

    try:
        yield
    except RayError as error:
        raise _reason("worked", error) from error


def _reason(doing: str, error: Exception) -> ChildProcessError:
    from ray.exceptions import RayTaskError

    if isinstance(error, RayTaskError) or getattr(error, "actor_init_failed", False):
        return failure(f"a worker of Ray failed while it {doing}", error)
    return ChildProcessError(
        f"a worker of Ray has ended while it {doing}. Ray's logs may give the reason, which is often a lack of memory: "
        "reduce collector.num_workers or training.num_envs"
    )
