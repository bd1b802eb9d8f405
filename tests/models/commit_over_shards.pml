/* A commit over two shards: acquire, validate, prepare, decide, finish, resolve, presumed abort.
 *
 * Each step names what it mirrors in enact_dist/core (file:function):
 *   shard/on_lock.py:on_acquire, state/grants.py:grant_ready   grant
 *   shard/shard.py:_expire, shard/on_lock.py:on_release,
 *   shard/on_session.py:on_keep_alive, state/grants.py:take_away   a lock ends; only if it is not `bound`
 *   state/commits.py:_fence, state/commits.py:refusal   FENCE
 *   state/commits.py:validate   validate
 *   shard/on_prepare.py:on_prepare, _persisted   prepare, and its record on disk
 *   state/commits.py:commit, _persisted, _apply, _recorded   the commit that decides
 *   state/decisions.py:decided, tell, finished   telling the participant
 *   shard/on_prepare.py:on_finish, _finish, _persisted   finish, and its end on disk
 *   shard/on_prepare.py:on_resolve, _resolved, on_called   resolve, presumed abort
 *   shard/on_prepare.py:__init__, state/grants.py:restore   restart
 *   client/lock.py:_on_acquiring, finish, _on_vote,
 *   _on_committing, _on_outcome, _gives_up, client/session.py:_epoch_changed   the client
 *
 * Network: what was sent stays deliverable for ever, so it may be late, doubled or overtaken; what
 * is lost is never delivered.  An answer that stays true once it is true (committed, fenced for
 * good) is given to the client in the step that makes it; the others are kept like requests.
 * Time: a lease may end at any moment, so no clock takes part.  The grace is left out: without it
 * more can happen.  Shards restart at any moment between two steps; a client may stop anywhere.
 *
 * A lock of two shards is of one of four kinds.  Shard A is the lower one: it is the primary
 * wherever it is written to.
 */
#ifndef CLIENTS
#define CLIENTS 2
#endif
#ifndef LOCKS                   /* of each client, one after the other */
#define LOCKS 1
#endif
#ifndef RESTARTS                /* of each shard */
#define RESTARTS 1
#endif
#ifndef KINDS
#define KINDS 3
#endif
#define N (CLIENTS * LOCKS)

#define A 0
#define B 1
#define WRITE_BOTH 1            /* B prepares, A decides */
#define WRITE_A 2               /* B validates, A commits */
#define WRITE_B 3               /* A validates, B commits */
#define ONLY_A 4                /* nothing at B */

#define at(s, t) ((s) * N + (t))
#define lane(s, t) ((s) * CLIENTS + (t) / LOCKS)
#define seq(t) ((t) % LOCKS + 1)
#define writes(s, t) (kind[t] == WRITE_BOTH || (kind[t] == WRITE_B -> s == B : s == A))
#define wants(s, t) (s == A || kind[t] != ONLY_A)
#define primary(t) (kind[t] == WRITE_B -> B : A)
#define prepares(s, t) (s == B && kind[t] == WRITE_BOTH)
#define validates(s, t) (wants(s, t) && !writes(s, t))

/* A client's lock. */
#define IDLE 0
#define ACQUIRING_A 1
#define ACQUIRING_B 2
#define HELD 3
#define VOTING 4
#define COMMITTING 5
#define COMMITTED 6             /* told: committed */
#define ENDED 7                 /* told: not committed, of whatever cause */
#define UNKNOWN 8               /* told: unknown, or its client is dead */
byte phase[N];
byte kind[N];
byte known_epoch[2 * CLIENTS];
byte token[2 * N];              /* the grant that the client took, by its epoch; 0: none */
byte was[2 * N];                /* the version that came with it */
byte then[2 * N];               /* ghost: the version when the client began to finish */

/* Messages under way, for ever. */
byte asked[2 * N];              /* Acquire, one bit for each epoch it may bear */
byte granted[2 * N];            /* Granted: epoch of the grant; its version is in `shown` */
byte shown[2 * N];
bool voting[N];                 /* Validate or Prepare */
bool valid[N];
bool prepared[N];
bool commit[N];
bool told[N];                   /* Finish, or Resolved(committed) */
bool aborted[N];                /* Resolved(aborted) */
bool finished[N];

/* A shard. */
byte epoch[2];
byte version[2];                /* durable: of its one slot */
byte outcome[2 * CLIENTS];      /* durable: seq of the lane's newest commit */
bool record[N];                 /* durable at B: PreparedRecord */
bool owed[N];                   /* durable at A: DecisionRecord */
byte top[2 * CLIENTS];          /* highest seq of a lane that was granted */
bool holds[2 * N];
byte number[2 * N];             /* token of the grant, by its epoch */
#define FREE 0
#define PREPARING 1             /* its record is at the store */
#define PREPARED 2
#define FINISHING 3             /* its end is at the store */
#define DECIDING 4              /* its commit is at the store */
byte stage[2 * N];

/* Ghosts: what happened for good. */
bool decided[N];
bool applied[N];
bool dropped[N];

byte rule;
#define BROKEN(n) rule = n; assert(rule != n)
#ifdef GOAL
#define REACHED(n) if :: n == GOAL -> BROKEN(100 + n) :: else fi
#else
#define REACHED(n) skip
#endif

#define blocks(u, s, t) (u != t && holds[at(s, u)] && (writes(s, u) || writes(s, t)))
#if N == 2
#define blocked(s, t) (blocks(0, s, t) || blocks(1, s, t))
#else
#define blocked(s, t) (blocks(0, s, t) || blocks(1, s, t) || blocks(2, s, t) || blocks(3, s, t))
#endif
#define FENCE(s, t) (holds[at(s, t)] && number[at(s, t)] == token[at(s, t)] && token[at(s, t)] == epoch[s])
#define recorded(s, t) (outcome[lane(s, t)] == seq(t))
#define bound(s, t) (stage[at(s, t)] != FREE)

#ifdef NO_FENCE                 /* whoever once had the lock may write, if nobody else holds it */
#define may_write(s, t) (token[at(s, t)] && !blocked(s, t))
#else
#define may_write(s, t) FENCE(s, t)
#endif
#ifdef PREPARED_ENDS            /* a lease or a release ends what is prepared */
#define may_end(s, t) (!bound(s, t) || stage[at(s, t)] == PREPARED)
#elif defined(IN_FLIGHT_ENDS)   /* a lease ends a commit that the disk works on */
#define may_end(s, t) (!bound(s, t) || stage[at(s, t)] == DECIDING)
#else
#define may_end(s, t) (!bound(s, t))
#endif
#ifdef FORGETS_OUTCOMES         /* a repeated commit finds no record of the first */
#define answers_committed(s, t) false
#else
#define answers_committed(s, t) recorded(s, t)
#endif
#ifdef FORGETS_DECISIONS        /* a primary that has committed does not know it any more */
#define knows_decision(t) false
#else
#define knows_decision(t) (owed[t] || recorded(A, t))
#endif
#ifdef ABORTS_OPEN              /* a primary that has not decided yet says that it never will */
#define open(t) false
#else
#define open(t) (holds[at(A, t)] && number[at(A, t)] == token[at(A, t)])
#endif
#ifdef COMMITS_WITHOUT_VOTES
#define voted(t) true
#elif defined(SKIPS_VALIDATION)
#define voted(t) (kind[t] != WRITE_BOTH || prepared[t])
#else
#define voted(t) (kind[t] == ONLY_A || (kind[t] == WRITE_BOTH -> prepared[t] : valid[t]))
#endif

/* A record that the store keeps takes with it whatever was handed in before. */
inline flush(t) {
  byte u;
  for (u : 0 .. N - 1) {
    if :: u != t && record[u] && stage[at(B, u)] == FREE -> record[u] = false :: else fi
  }
  u = 0
}

inline begin_to_finish(t) {
  voting[t] = true;
  then[at(A, t)] = version[A];
  then[at(B, t)] = version[B]
}

inline decide(s, t) {
  if
  :: was[at(s, t)] != version[s] -> BROKEN(2)
  :: then[at(A, t)] != was[at(A, t)] -> BROKEN(6)
  :: wants(B, t) && then[at(B, t)] != was[at(B, t)] -> BROKEN(6)
  :: !holds[at(s, t)] -> BROKEN(17)
  :: else
  fi;
  version[s]++;
  outcome[lane(s, t)] = seq(t);
  decided[t] = true;
  stage[at(s, t)] = FREE;
  holds[at(s, t)] = false;
  number[at(s, t)] = 0;
  if
  :: kind[t] == WRITE_BOTH -> owed[t] = true; told[t] = true
  :: else
  fi
}

proctype Client(byte t) {
  end: do
  :: atomic { phase[t] == IDLE && (seq(t) == 1 || phase[t - 1] >= COMMITTED) ->
       if
       :: kind[t] = WRITE_BOTH
       :: KINDS > 1 -> kind[t] = WRITE_A
       :: KINDS > 2 -> kind[t] = WRITE_B
       :: KINDS > 3 -> kind[t] = ONLY_A
       fi;
       asked[at(A, t)] = 1 << known_epoch[lane(A, t)];
       phase[t] = ACQUIRING_A }
  :: atomic { phase[t] == ACQUIRING_A && granted[at(A, t)] && granted[at(A, t)] == known_epoch[lane(A, t)] ->
       token[at(A, t)] = granted[at(A, t)];
       was[at(A, t)] = shown[at(A, t)];
       if
       :: kind[t] == ONLY_A -> phase[t] = HELD
       :: else ->
          asked[at(B, t)] = asked[at(B, t)] | (1 << known_epoch[lane(B, t)]);
          phase[t] = ACQUIRING_B
       fi }
  :: atomic { phase[t] == ACQUIRING_B && granted[at(B, t)] && granted[at(B, t)] == known_epoch[lane(B, t)] ->
       token[at(B, t)] = granted[at(B, t)];
       was[at(B, t)] = shown[at(B, t)];
       phase[t] = HELD }
  :: atomic { phase[t] == HELD -> begin_to_finish(t); phase[t] = VOTING }
  :: atomic { phase[t] == VOTING && voted(t) -> commit[t] = true; phase[t] = COMMITTING }
  /* A lock may be lost, given up or orphaned at any moment; after the commit it is unknown. */
  :: atomic { phase[t] > IDLE && phase[t] < COMMITTING -> phase[t] = ENDED }
#ifdef GUESSES                  /* silence after the commit is taken for a no */
  :: atomic { phase[t] == COMMITTING -> phase[t] = ENDED }
#else
  :: atomic { phase[t] == COMMITTING -> phase[t] = UNKNOWN }
#endif
  od
}

/* The client's session hears of a shard's new epoch: a first acquire is asked again, a grant there
 * is over.  What another shard decides goes on: that shard is asked again and knows. */
proctype Epochs(byte s; byte t) {
  end: do
  :: atomic { phase[t] > IDLE && phase[t] < COMMITTED && known_epoch[lane(s, t)] != epoch[s] ->
       known_epoch[lane(s, t)] = epoch[s];
       if
       :: token[at(s, t)] && (phase[t] < VOTING || (phase[t] == VOTING && s == primary(t))) -> phase[t] = ENDED
       :: !token[at(s, t)] && asked[at(s, t)] && phase[t] < VOTING ->
          asked[at(s, t)] = asked[at(s, t)] | (1 << epoch[s])
       :: else
       fi }
  od
}

proctype Shard(byte s; byte t) {
  end: do
  /* acquire */
  :: atomic { (asked[at(s, t)] & (1 << epoch[s])) && top[lane(s, t)] < seq(t) && !blocked(s, t) ->
       top[lane(s, t)] = seq(t);
       holds[at(s, t)] = true;
       number[at(s, t)] = epoch[s];
       granted[at(s, t)] = epoch[s];
       shown[at(s, t)] = version[s] }
  /* the end of a lease or hold limit, a release, a newer lock of its lane, a keep-alive's view */
  :: atomic { holds[at(s, t)] && may_end(s, t) ->
#ifdef PREPARED_ENDS
       if :: stage[at(s, t)] == PREPARED -> record[t] = false; dropped[t] = true; stage[at(s, t)] = FREE :: else fi;
#endif
       holds[at(s, t)] = false;
       number[at(s, t)] = 0 }
  /* validate */
  :: atomic { validates(s, t) && voting[t] && FENCE(s, t) ->
       valid[t] = true;
       holds[at(s, t)] = false;
       number[at(s, t)] = 0;
       REACHED(1) }
  /* prepare */
  :: atomic { prepares(s, t) && voting[t] && !bound(s, t) && may_write(s, t) ->
       holds[at(s, t)] = true;
       number[at(s, t)] = token[at(s, t)];
       stage[at(s, t)] = PREPARING;
#ifdef PROMISES_EARLY           /* Prepared is answered while the disk still works on the record */
       prepared[t] = true
#endif
       }
  :: atomic { stage[at(s, t)] == PREPARING ->
       stage[at(s, t)] = PREPARED;
       record[t] = true;
       prepared[t] = true;
       flush(t) }
  /* commit: it decides */
  :: atomic { s == primary(t) && commit[t] && !recorded(s, t) && !bound(s, t) && may_write(s, t) ->
       holds[at(s, t)] = true;
       number[at(s, t)] = token[at(s, t)];
       stage[at(s, t)] = DECIDING;
#ifdef TELLS_EARLY              /* participants hear of a decision that the disk still works on */
       told[t] = (kind[t] == WRITE_BOTH)
#endif
       }
  :: atomic { stage[at(s, t)] == DECIDING -> decide(s, t); if :: s == B -> flush(t) :: else fi }
  :: atomic { s == primary(t) && phase[t] == COMMITTING && answers_committed(s, t) -> phase[t] = COMMITTED; REACHED(2) }
  :: atomic { s == primary(t) && phase[t] == COMMITTING && !answers_committed(s, t) && !bound(s, t) &&
         token[at(s, t)] == epoch[s] && !FENCE(s, t) -> phase[t] = ENDED; REACHED(3) }   /* Fenced */
  :: atomic { s == primary(t) && phase[t] == COMMITTING && !answers_committed(s, t) &&
         token[at(s, t)] != epoch[s] -> phase[t] = ENDED; REACHED(4) }                   /* unseen, in a new epoch */
#ifndef NEVER_TELLS
  /* resolve: the primary is asked by the participant, and answers by what it knows */
  :: atomic { s == A && prepared[t] && !told[t] && knows_decision(t) -> told[t] = true }
  :: atomic { s == A && prepared[t] && !aborted[t] && !knows_decision(t) && !open(t) ->
       aborted[t] = true;
       if :: decided[t] -> REACHED(5) :: else fi }                       /* late: finished and forgotten */
  /* finish */
  :: atomic { s == B && told[t] && stage[at(s, t)] == PREPARED ->
       stage[at(s, t)] = FINISHING;
#ifdef FINISHED_EARLY           /* Finished is said while the disk still works on the end */
       finished[t] = true
#endif
       }
  :: atomic { stage[at(s, t)] == FINISHING ->
       if
       :: was[at(s, t)] != version[s] -> BROKEN(2)
       :: then[at(B, t)] != was[at(B, t)] -> BROKEN(6)
       :: else
       fi;
       version[s]++;
       applied[t] = true;
       record[t] = false;
       stage[at(s, t)] = FREE;
       holds[at(s, t)] = false;
       number[at(s, t)] = 0;
       finished[t] = true;
       if :: epoch[B] > 1 && token[at(B, t)] == 1 -> REACHED(6) :: else fi;             /* restored, then finished */
       if :: epoch[A] > 1 && token[at(A, t)] == 1 && phase[t] == UNKNOWN -> REACHED(7) :: else fi;
       flush(t) }
  :: atomic { s == B && told[t] && !finished[t] && (stage[at(s, t)] == FREE || stage[at(s, t)] == PREPARING) -> finished[t] = true }
  :: atomic { s == A && finished[t] && owed[t] -> owed[t] = false }
  /* presumed abort; the store forgets the record when it comes to it */
  :: atomic { s == B && aborted[t] && stage[at(s, t)] == PREPARED ->
       stage[at(s, t)] = FREE;
       holds[at(s, t)] = false;
       number[at(s, t)] = 0;
       if :: dropped[t] -> REACHED(8) :: else fi;                        /* restored after its end, dropped again */
       dropped[t] = true;
       REACHED(9) }
#endif
  :: atomic { s == B && record[t] && stage[at(s, t)] == FREE -> record[t] = false }
  od
}

proctype Restart(byte s) {
  byte t;
  end: do
  :: atomic { epoch[s] <= RESTARTS ->
       epoch[s]++;
       for (t : 0 .. N - 1) {
         if
         :: s == B && record[t] ->
#ifdef FORGETS_PREPARED
            record[t] = false; stage[at(s, t)] = FREE; holds[at(s, t)] = false; number[at(s, t)] = 0
#elif defined(RESTORES_NO_LOCK)
            stage[at(s, t)] = PREPARED; holds[at(s, t)] = false; number[at(s, t)] = 0
#else
            stage[at(s, t)] = PREPARED; holds[at(s, t)] = true; number[at(s, t)] = token[at(s, t)]
#endif
         :: else -> stage[at(s, t)] = FREE; holds[at(s, t)] = false; number[at(s, t)] = 0
         fi;
         top[lane(s, t)] = outcome[lane(s, t)]
       }
       t = 0 }
  od
}

#define conflict(s, t) (holds[at(s, t)] && blocked(s, t))
#define busy(s, t) (holds[at(s, t)] || stage[at(s, t)] != FREE)

/* Looks at every state; blocked unless a rule is broken (numbers of protocol.md, section 10). */
proctype Judge(byte t) {
  end: do
  :: atomic { conflict(A, t) || conflict(B, t) -> BROKEN(1) }
  :: atomic { decided[t] && kind[t] == WRITE_BOTH && !applied[t] && !record[t] -> BROKEN(3) }
  :: atomic { applied[t] && !decided[t] -> BROKEN(3) }
  :: atomic { phase[t] == COMMITTED && !decided[t] -> BROKEN(5) }
  :: atomic { phase[t] == ENDED && decided[t] -> BROKEN(5) }
  :: atomic { dropped[t] && decided[t] -> BROKEN(9) }
  :: atomic { stage[at(B, t)] >= PREPARED && stage[at(B, t)] <= FINISHING && !(record[t] && holds[at(B, t)]) -> BROKEN(10) }
  :: atomic { timeout && (busy(A, t) || busy(B, t) || owed[t] || record[t]) -> BROKEN(12) }
  od
}

init {
  byte t;
  atomic {
    epoch[A] = 1; epoch[B] = 1;
    for (t : 0 .. CLIENTS - 1) { known_epoch[lane(A, t * LOCKS)] = 1; known_epoch[lane(B, t * LOCKS)] = 1 }
    for (t : 0 .. N - 1) {
      run Client(t); run Epochs(A, t); run Epochs(B, t); run Shard(A, t); run Shard(B, t); run Judge(t)
    }
    run Restart(A); run Restart(B);
    t = 0
  }
}
