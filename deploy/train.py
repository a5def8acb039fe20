"""What `ray submit deploy/cluster.yaml deploy/train.py -- --config FILE` runs on the cluster's head.

The service itself is what the set-up commands of the cluster file installed on every node.
"""

import runpy

runpy.run_module("services.cluster", run_name="__main__")
