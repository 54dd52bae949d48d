"""An executor that runs submitted jobs on demand."""

from concurrent.futures import Executor, Future


class DeferredExecutor(Executor):
    """Runs one submitted job per call of `run_next`."""

    def __init__(self) -> None:
        self.jobs: list[tuple[Future, object, tuple]] = []

    def submit(self, function, /, *arguments):
        future: Future = Future()
        self.jobs.append((future, function, arguments))
        return future

    def run_next(self) -> None:
        future, function, arguments = self.jobs.pop(0)
        try:
            future.set_result(function(*arguments))
        except Exception as error:
            future.set_exception(error)

    @property
    def frames(self) -> list[int]:
        return [arguments[0].index for _, _, arguments in self.jobs]
