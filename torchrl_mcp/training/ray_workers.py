"""Ray's workers: collectors in Ray's processes, and the reason when one of them fails."""

from collections.abc import Iterator
from contextlib import contextmanager
from traceback import clear_frames

from torchrl.collectors import Collector

from torchrl_mcp.training.workers import failure


class RayWorker(Collector):
    """TorchRL's collector in a process of Ray."""

    def __bool__(self) -> bool:
        """Return True: Ray asks for it where the constructor failed, and TorchRL would count the remaining batches."""
        return True


@contextmanager
def starting() -> Iterator[None]:
    """If the block, which makes a collector of Ray's workers, fails, end them and say why.

    Raises:
        ChildProcessError: If a worker ends, or fails with another error than those below.
        OSError: Of the block.
        ValueError: Likewise.
    """
    from ray.exceptions import RayError

    try:
        yield
    except Exception as error:
        # The collector ends its workers, and Ray if it started Ray, as soon as no frame refers to it.
        clear_frames(error.__traceback__)
        if isinstance(error, RayError):
            raise _reason("started", error) from error
        if isinstance(error, (OSError, ValueError)):
            raise
        raise failure("Ray's workers cannot be started", error) from error


@contextmanager
def working() -> Iterator[None]:
    """Say why a worker fails or ends in the block.

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
        f"a worker of Ray has ended while it {doing}. Ray's logs may say why; often memory ran out: try fewer "
        "collector.num_workers or training.num_envs"
    )
