"""Batches for training and validation, a pure function of the seed and of the step they are for."""

import signal
from collections.abc import Callable, Iterator

import lightning
import numpy as np
from torch.utils.data import DataLoader, Dataset, Sampler

from extrap_train.config import TrainConfig
from extrap_train.data.examples import Example, ExampleReader, linspace_indices, mirror
from extrap_train.geometry.warp import compute_warp
from extrap_train.jobs import available_cores, start_fork_server
from extrap_train.views import PackedBatch, PairBatch

_PRELOAD = ("extrap_train.data.module",)
Positions = list[tuple[int, int]]
"""(position in the endless stream of examples, index of the pair)."""


class PositionSampler(Sampler[Positions]):
    """Batches of one epoch from an endless stream of shuffled passes over the pairs, `batch_size`
    pairs in each.

    Nothing is remembered: `steps_done`, asked at the start of an epoch, says where in the stream it
    begins, however long the epochs before it were. So a killed run and a prolonged one see what an
    undisturbed run sees.
    """

    def __init__(
        self,
        pairs: int,
        batch_size: int,
        batches: int,
        seed: int,
        *,
        steps_done: Callable[[], int],
        rank: int = 0,
        world: int = 1,
    ) -> None:
        self.pairs, self.batch_size, self.batches, self.seed = pairs, batch_size, batches, seed
        self.steps_done, self.rank, self.world = steps_done, rank, world

    def __len__(self) -> int:
        return self.batches

    def __iter__(self) -> Iterator[Positions]:
        orders: dict[int, np.ndarray] = {}
        first = self.steps_done() * self.batch_size * self.world
        for batch in range(self.batches):
            start = first + (batch * self.world + self.rank) * self.batch_size
            positions = range(start, start + self.batch_size)
            cycles = {position // self.pairs for position in positions}
            orders = {
                cycle: orders[cycle] if cycle in orders else self._order(cycle) for cycle in cycles
            }
            yield [(p, int(orders[p // self.pairs][p % self.pairs])) for p in positions]

    def _order(self, cycle: int) -> np.ndarray:
        return np.random.default_rng((self.seed, cycle)).permutation(self.pairs)


class TrainingBatches(Dataset[PackedBatch]):
    """Whole batches by their positions: one to all of the reader's references, half mirrored."""

    def __init__(self, reader: ExampleReader, seed: int) -> None:
        self.reader, self.seed = reader, seed

    def __getitem__(self, positions: Positions) -> PackedBatch:
        examples: list[Example] = []
        for position, pair in positions:
            rng = np.random.default_rng((self.seed, position))
            count = int(rng.integers(1, self.reader.references + 1))
            example = self.reader.read(pair, count, rng)
            examples.append(mirror(example) if rng.random() < 0.5 else example)
        return self.reader.pack(examples)


class ValidationBatches(Dataset[PackedBatch]):
    """The same examples, with all their references, every time."""

    def __init__(self, reader: ExampleReader, chosen: list[int], size: int) -> None:
        self.reader = reader
        self.batches = [chosen[i : i + size] for i in range(0, len(chosen), size)]

    def __len__(self) -> int:
        return len(self.batches)

    def __getitem__(self, index: int) -> PackedBatch:
        read, count = self.reader.read, self.reader.references
        return self.reader.pack(
            [read(pair, count, np.random.default_rng(pair)) for pair in self.batches[index]]
        )


class PairModule(lightning.LightningDataModule):
    """Training and validation batches; the warp is made after the batch has reached its device."""

    def __init__(
        self, train: ExampleReader, validation: ExampleReader, config: TrainConfig
    ) -> None:
        super().__init__()
        self.train, self.validation, self.config = train, validation, config
        chosen = linspace_indices(len(validation), config.validation.examples)
        self.held_out = ValidationBatches(validation, chosen, config.validation.batch_size)
        """Spread evenly over the test pairs."""

    @property
    def batches_per_epoch(self) -> int:
        """Steps from one checkpoint to the next."""
        return min(self.config.trainer.checkpoint_every, self.config.trainer.steps)

    def train_dataloader(self) -> DataLoader[PackedBatch]:
        """The batches up to the next checkpoint, at a multiple of `batches_per_epoch` steps."""
        trainer = self.trainer
        done = trainer.global_step if trainer else 0
        sampler = PositionSampler(
            len(self.train),
            self.config.trainer.batch_size,
            self.batches_per_epoch - done % self.batches_per_epoch,
            self.config.seed,
            steps_done=lambda: trainer.global_step if trainer else 0,
            rank=trainer.global_rank if trainer else 0,
            world=trainer.world_size if trainer else 1,
        )
        return self._loader(TrainingBatches(self.train, self.config.seed), sampler)

    def val_dataloader(self) -> DataLoader[PackedBatch]:
        """Held-out examples; processes take turns at them."""
        trainer = self.trainer
        rank, world = (trainer.global_rank, trainer.world_size) if trainer else (0, 1)
        return self._loader(self.held_out, shard(len(self.held_out), rank, world))

    def validation_names(self) -> list[list[str]]:
        """What the held-out views of each validation batch are called."""
        return [[self.validation.name(i) for i in batch] for batch in self.held_out.batches]

    def _loader(
        self, dataset: Dataset[PackedBatch], sampler: Sampler[Positions] | list[int]
    ) -> DataLoader[PackedBatch]:
        """Workers come from a server of their own: forked from this process, they would keep the
        memory that its weights had at that moment.
        """
        workers = min(self.config.trainer.workers, available_cores())
        device = self.trainer.strategy.root_device.type if self.trainer else "cpu"
        return DataLoader(
            dataset,
            batch_size=None,
            sampler=sampler,
            num_workers=workers,
            multiprocessing_context=start_fork_server(_PRELOAD) if workers else None,
            worker_init_fn=_ignore_interrupts,
            persistent_workers=workers > 0,
            pin_memory=device == "cuda",
        )

    def on_after_batch_transfer(self, batch: PackedBatch, dataloader_idx: int) -> PairBatch:
        """Lightning's hook: warps are computed, not stored."""
        return compute_warp(batch.unpack(), self.config.model.image_size)


def _ignore_interrupts(worker: int) -> None:
    """Ctrl-C reaches every process of a terminal; the one that trains finishes its step first."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def shard(batches: int, rank: int, world: int) -> list[int]:
    """Indices of a process's batches; a process too many repeats the last one.

    In a process without a batch, Lightning runs no validation and no exchange at its end.
    """
    return list(range(rank, batches, world)) or [batches - 1]
