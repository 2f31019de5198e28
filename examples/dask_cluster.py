"""Match a folder of pairs on a Dask cluster, as `stereokit batch pairs -o maps --engine dask --scheduler ...` does."""

from pathlib import Path

import numpy as np
from distributed import Client, LocalCluster

import stereokit
from stereokit_evaluation.batch.dask import on_cluster
from stereokit_evaluation.batch.job import Job
from stereokit_evaluation.batch.pairs import folder_pairs
from stereokit_evaluation.batch.run import on_threads, run_batch


def main():
    """Start two workers on this machine, and give them twelve pairs."""
    for side in ("left", "right"):
        Path("pairs", side).mkdir(parents=True)
    for number in range(12):
        left = np.random.default_rng(number).integers(0, 256, (60, 160), dtype=np.uint8)
        stereokit.io.write_image(f"pairs/left/{number:02d}.png", left)
        stereokit.io.write_image(f"pairs/right/{number:02d}.png", np.roll(left, -7, axis=1))

    job = Job(str(Path("maps").resolve()), ".png", False, "S2", (("max_disparity", 32),))
    pairs = folder_pairs(Path("pairs"))
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:
        summary = run_batch(job, pairs, lambda job, pairs: on_cluster(job, pairs, client), inputs="pairs")
    print(f"{summary.written} maps written, {summary.failed} failed")
    again = run_batch(job, pairs, on_threads, inputs="pairs")  # this machine goes on: nothing is left to do
    print(f"{again.existing} maps found")


if __name__ == "__main__":  # the workers are processes that load this file too
    main()
