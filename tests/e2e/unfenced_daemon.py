"""A shard daemon without its fence, to see that the chaos run notices."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "sim"))

import mutants_one_shard

from enact_dist.verify.chaos import daemon

if __name__ == "__main__":
    mutants_one_shard.no_fence(setattr)
    sys.exit(daemon.run(sys.argv[1:]))
