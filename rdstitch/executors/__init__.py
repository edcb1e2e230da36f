"""Where the tasks of a run are computed: threads, worker processes or a Dask cluster, behind one interface.

Stages take a :class:`concurrent.futures.Executor` and use nothing but its ``submit``. Their tasks are functions of this
package with small arguments and results; what is large lies in the cache of the run.
"""

from rdstitch.executors.choice import open_executor
from rdstitch.executors.dask_cluster import LOCAL, DaskExecutor
from rdstitch.executors.in_order import in_order
from rdstitch.executors.processes import ProcessExecutor

__all__ = ["LOCAL", "DaskExecutor", "ProcessExecutor", "in_order", "open_executor"]
