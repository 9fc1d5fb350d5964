"""Extra dask: the same report on a cluster of one worker on this machine."""

from distributed import LocalCluster

from neuroprior import MarkovPrior, Plans, UniformPrior
from neuroprior.behaviour import FitOptions, report

if __name__ == "__main__":
    plans = Plans(MarkovPrior(3, 1).sample(40, 20), 3)
    with LocalCluster(n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None) as cluster:
        fits = FitOptions(["counts"], dask=cluster.scheduler_address)
        models = report(plans, fits=fits, sections=["scores"], out="report")
    assert len(models.tables["plans"])
    assert UniformPrior
