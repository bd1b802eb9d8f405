/* Two locks that each expect a view of what the other writes: one of them must fail.
 *
 * Each step names what it mirrors in enact_dist/core (file:function):
 *   state/commits.py:moved_on, _in_the_way, _newest_version   still_stands
 *   state/commits.py:validate, _expected   an expectation where nothing is held
 *   state/commits.py:commit, _persisted, _apply   a commit that expects something itself
 *   client/lock.py:_acquire (`alone`), finish, _after_votes   the client
 *   state/grants.py:take_away, shard/shard.py:_expire   the end of a lease
 *
 * Lock 0 writes slot 0 and expects slot 1 as it viewed it, lock 1 the other way round.  On two
 * shards each validates its expectation at the other's shard before it commits at its own; with
 * ONE_SHARD the commit compares.  Messages are late or doubled at will, as in the other models.
 */
#ifndef ONE_SHARD
#define ONE_SHARD 0
#endif
#ifndef ROUNDS
#define ROUNDS 2                /* locks of each client, one after the other; a new one starts over */
#endif
#define other(t) (1 - (t))

#define IDLE 0
#define ACQUIRED 1
#define VIEWED 2
#define FINISHING 3
#define COMMITTING 4
#define COMMITTED 5
#define ENDED 6
byte phase[2];
byte made[2];                   /* locks so far */
byte viewed[2];                 /* version of the other's slot */
bool valid[2];

byte version[2];
bool holds[2];
bool at_store[2];               /* its commit is at the store */

/* Ghosts: what the newest commit of each had viewed, and wrote. */
byte saw[2];
byte wrote[2];

byte rule;
#define BROKEN(n) rule = n; assert(rule != n)
#ifdef GOAL
#define REACHED(n) if :: n == GOAL -> BROKEN(100 + n) :: else fi
#else
#define REACHED(n) skip
#endif

#ifdef CALLED_ALONE             /* a lock that views elsewhere is said to lie on one shard alone */
#define alone(t) true
#else
#define alone(t) ONE_SHARD
#endif
#ifdef BESIDE_WRITERS           /* an expected view does not mind who holds the slot for writing */
#define in_the_way(t) false
#else
#define in_the_way(t) (holds[t] && !alone(t))
#endif
#ifdef OVERLOOKS_IN_FLIGHT      /* a commit that the disk works on is not there yet */
#define newest(t) version[t]
#else
#define newest(t) (version[t] + at_store[t])
#endif
#ifdef EXPECTS_NOTHING
#define still_stands(t) true
#else
#define still_stands(t) (newest(other(t)) == viewed[t] && !in_the_way(other(t)))
#endif

proctype Client(byte t) {
  end: do
  :: atomic { (phase[t] == IDLE || phase[t] >= COMMITTED) && made[t] < ROUNDS && !holds[t] ->
       made[t]++; holds[t] = true; valid[t] = false; phase[t] = ACQUIRED }
  :: atomic { phase[t] == ACQUIRED -> viewed[t] = version[other(t)]; phase[t] = VIEWED }
  :: atomic { phase[t] == VIEWED -> phase[t] = FINISHING }
  :: atomic { phase[t] == FINISHING && (ONE_SHARD || valid[t]) -> phase[t] = COMMITTING }
  :: atomic { phase[t] >= ACQUIRED && phase[t] <= COMMITTING && !at_store[t] -> phase[t] = ENDED }
  od
}

proctype Shard(byte t) {
  end: do
  :: atomic { holds[t] && !at_store[t] -> holds[t] = false }     /* lease, release, restart */
  /* validate, at the other's shard */
  :: atomic { !ONE_SHARD && phase[t] == FINISHING && !valid[t] && still_stands(t) -> valid[t] = true }
  :: atomic { !ONE_SHARD && phase[t] == FINISHING && !still_stands(t) -> phase[t] = ENDED; REACHED(1) }
  /* commit */
  :: atomic { phase[t] == COMMITTING && !at_store[t] && holds[t] && (!ONE_SHARD || still_stands(t)) -> at_store[t] = true }
  :: atomic { phase[t] == COMMITTING && !at_store[t] && holds[t] && ONE_SHARD && !still_stands(t) ->
       holds[t] = false; phase[t] = ENDED; REACHED(2) }
  :: atomic { at_store[t] ->
       at_store[t] = false; holds[t] = false;
       version[t]++;
       saw[t] = viewed[t]; wrote[t] = version[t];
       phase[t] = COMMITTED;
       if :: wrote[other(t)] && saw[t] == wrote[other(t)] && saw[other(t)] < wrote[t] -> REACHED(3) :: else fi }
  :: atomic { at_store[t] -> at_store[t] = false; holds[t] = false; phase[t] = ENDED }   /* a crash */
  od
}

/* Neither comes before the other: each has overlooked what the other wrote. */
proctype Judge() {
  end: do
  :: atomic { wrote[0] && wrote[1] && saw[0] < wrote[1] && saw[1] < wrote[0] -> BROKEN(6) }
  od
}

init { atomic { run Client(0); run Client(1); run Shard(0); run Shard(1); run Judge() } }
