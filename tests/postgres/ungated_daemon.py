"""A shard daemon whose lease never ends, to see that the chaos run notices."""

import sys

from enact_dist.core.failover.lease import Lease
from enact_dist.verify.chaos.replicated import daemon

if __name__ == "__main__":
    Lease.holds = lambda _lease, _now_ns: True
    sys.exit(daemon.run(sys.argv[1:]))
