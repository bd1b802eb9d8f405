/* Views over two shards as one cut, beside commits over both shards, without synchronised clocks.
 *
 * Each step names what it mirrors in enact_dist/core (file:function):
 *   state/clock.py:next, saw, now, shard/state.py:stamp   a shard's clock of stamps
 *   shard/on_prepare.py:on_prepare, _finish, _persisted, undecided   prepare, finish at B
 *   state/commits.py:commit, _persisted, undecided   the commit that decides, at A
 *   client/finishing.py:commit   its stamp comes after the prepared ones
 *   shard/on_view.py:on_take_view, _undecided_ns, _viewed   view, and until when it is current
 *   state/slots.py:shown, at, state/retention.py:at   the state as of a stamp, if not forgotten
 *   client/cut.py:take, settled   the cut
 *   shard/shard.py:__init__, state/sessions.py:in_grace   restart; the grace waits for a viewer that
 *                                                        locks, not for an observer
 *   client/lease_clock.py:believe_until_ns, client/lock.py:_on_viewed   for how long an answer counts
 *
 * Every commit writes both shards, so a cut is whole if both show the same commit.  A view that
 * waits for what is undecided may be answered without waiting here: it is so after 0.4 s too.
 * Clocks go on at any pace, and go back at a restart as far as the records let them.
 */
#ifndef COMMITS
#define COMMITS 2
#endif
#ifndef CLOCK_MAX
#define CLOCK_MAX 6
#endif
#ifndef ELSEWHERE               /* views at other shards too */
#define ELSEWHERE 0
#endif
#ifndef RESTARTS
#define RESTARTS 1
#endif
#ifndef ROUNDS
#define ROUNDS 3
#endif
#ifndef OBSERVER                /* the viewer's session is not waited for by a grace */
#define OBSERVER 0
#endif

#define A 0                     /* primary */
#define B 1                     /* prepares */

byte clock[2];
byte epoch[2];

#define IDLE 0
#define PREPARED 1
#define DECIDING 2              /* its commit is at A's store, stamped */
#define DECIDED 3
#define FINISHING 4             /* its end is at B's store */
#define FINISHED 5
#define ABORTED 6
byte stage[COMMITS];
byte prepared_at[COMMITS];      /* stamp at B */
byte stamp[COMMITS];
bool dead[COMMITS];             /* its grant at A is lost: it never decides */

/* The viewer. */
#define BEGUN 1
#define SETTLED 2
#define GIVEN_UP 3
byte viewer = BEGUN;
byte at;                        /* stamp as of which it asks; 0: now */
byte elsewhere;                 /* largest lower end at other shards, or its session's own commits */
byte round = 1;
bool left[2];
byte known_epoch[2];
/* The answer of each shard; may be under way for long. */
bool answered[2];
byte shows[2];                  /* number of the newest commit shown; 0: none */
byte from[2];
byte until[2];
byte of_epoch[2];
bool fresh[2];                  /* a TTL has not passed since this answer was asked for */
/* An observer's first answers, until it knows that nobody had restarted. */
bool first_there;
byte first_shows[2];
byte first_epoch[2];

byte rule;
#define BROKEN(n) rule = n; assert(rule != n)
#ifdef GOAL
#define REACHED(n) if :: n == GOAL -> BROKEN(100 + n) :: else fi
#else
#define REACHED(n) skip
#endif
#define max(a, b) ((a) > (b) -> (a) : (b))
#define min(a, b) ((a) < (b) -> (a) : (b))

#define visible(s, k) (stage[k] == FINISHED || (s == A && stage[k] >= DECIDED && stage[k] <= FINISHING))
#define undecided(s, k) (s == B -> stage[k] >= PREPARED && stage[k] <= FINISHING : stage[k] == DECIDING)
#define its_stamp(s, k) (s == B -> prepared_at[k] : stamp[k])
#define at_rest(s, k) (stage[k] >= FINISHED || (s == A && stage[k] >= DECIDED))
#ifdef STAMPS_ALONE             /* a commit is stamped by its primary's clock alone */
#define after_prepares(k) 0
#else
#define after_prepares(k) (prepared_at[k] + 1)
#endif
#ifdef NO_GRACE                 /* a restarted shard does not wait for whom it answered before */
#define may_grant(s) true
#else
#define may_grant(s) (OBSERVER || known_epoch[s] == epoch[s] || !fresh[s])
#endif
#ifdef NO_CONFIRMATION          /* an observer takes its first answers */
#define asks_twice false
#else
#define asks_twice OBSERVER
#endif
#ifdef OLD_EPOCHS_COUNT         /* an answer of an epoch that is over counts */
#define counts(s) true
#else
#define counts(s) (of_epoch[s] == known_epoch[s] && fresh[s])
#endif
#ifdef FIRST_VIEWS              /* views are taken as they come */
#define lags(s, t) false
#else
#define lags(s, t) (until[s] < t || !counts(s))
#endif

proctype Commit(byte k) {
  byte next;
  end: do
  :: atomic { viewer == BEGUN && stage[k] == IDLE && (k == 0 || at_rest(B, k - 1)) && may_grant(A) && may_grant(B) && clock[B] < CLOCK_MAX ->
       clock[B]++;
       prepared_at[k] = clock[B];
       stage[k] = PREPARED }
  :: atomic { viewer == BEGUN && stage[k] == PREPARED && !dead[k] && max(clock[A] + 1, after_prepares(k)) <= CLOCK_MAX ->
       next = max(clock[A] + 1, after_prepares(k));
       stamp[k] = next;
       clock[A] = next;
       next = 0;
       stage[k] = DECIDING }
  :: atomic { viewer == BEGUN && stage[k] == PREPARED -> stage[k] = ABORTED; dead[k] = false }
  :: atomic { viewer == BEGUN && stage[k] == DECIDING -> stage[k] = DECIDED }
  :: atomic { viewer == BEGUN && stage[k] == DECIDED -> clock[B] = max(clock[B], stamp[k]); stage[k] = FINISHING }
  :: atomic { viewer == BEGUN && stage[k] == FINISHING -> stage[k] = FINISHED }
  od
}

inline look(s, as_of) {
  byte k;
  shows[s] = 0; from[s] = 0; until[s] = (at > clock[s] -> at : clock[s]);
  for (k : 0 .. COMMITS - 1) {
    if
    :: visible(s, k) && (as_of == 0 || stamp[k] <= as_of) -> shows[s] = k + 1; from[s] = stamp[k]
    :: else
    fi
  }
#ifndef IGNORES_UNDECIDED       /* a view promises to be current though something is undecided */
  for (k : 0 .. COMMITS - 1) {
    if :: undecided(s, k) -> until[s] = min(until[s], its_stamp(s, k) - 1) :: else fi
  }
#endif
  if :: at && until[s] > at -> until[s] = at :: else fi;
  k = 0;
  answered[s] = true;
  of_epoch[s] = epoch[s];
  fresh[s] = true
}

proctype Shard(byte s) {
  end: do
  :: atomic { viewer == BEGUN && clock[s] < CLOCK_MAX -> clock[s]++ }
  :: atomic { viewer == BEGUN && left[s] && !answered[s] && known_epoch[s] == epoch[s] ->
#ifndef CLOCK_STAYS             /* asked as of a stamp, a shard does not move its clock past it */
       clock[s] = max(clock[s], at);
#endif
       if
       :: look(s, at)
       :: at -> look(s, 0)                       /* the past is forgotten, the present is shown */
       fi }
  :: atomic { viewer == BEGUN && RESTARTS && fresh[s] -> fresh[s] = false }
  :: atomic { viewer == BEGUN && known_epoch[s] != epoch[s] -> known_epoch[s] = epoch[s] }
  :: atomic { viewer == BEGUN && epoch[A] + epoch[B] < 2 + RESTARTS ->
       byte k;
       epoch[s]++;
       clock[s] = 1;
       for (k : 0 .. COMMITS - 1) {
         if
         :: s == A && (stage[k] == DECIDING || stage[k] == PREPARED) -> stage[k] = PREPARED; stamp[k] = 0; dead[k] = true
         :: s == B && stage[k] == FINISHING -> stage[k] = DECIDED
         :: else
         fi;
         if
         :: stage[k] == ABORTED -> skip
         :: visible(s, k) -> clock[s] = max(clock[s], stamp[k])
         :: s == B && stage[k] >= PREPARED && stage[k] <= DECIDED -> clock[s] = max(clock[s], prepared_at[k])
         :: else
         fi
       }
       k = 0 }
  od
}

inline forget(s) {
  answered[s] = false; fresh[s] = false; of_epoch[s] = 0;
  shows[s] = 0; from[s] = 0; until[s] = 0
}

#define confirmed (first_there && of_epoch[A] == first_epoch[A] && of_epoch[B] == first_epoch[B])

inline settle(a, b) {
  if :: a != b -> BROKEN(18) :: else fi;
  if :: round == 1 && a -> REACHED(1) :: else fi;
  if :: at && a == 1 && visible(A, COMMITS - 1) && COMMITS > 1 -> REACHED(2) :: else fi;
  if :: epoch[B] > known_epoch[B] && a -> REACHED(3) :: else fi;
  if :: first_there && a -> REACHED(7) :: else fi;
  viewer = SETTLED
}

/* The next round: whoever lags is asked again, or all of them by an observer. */
inline ask_again(t) {
  if :: of_epoch[A] != known_epoch[A] || of_epoch[B] != known_epoch[B] -> REACHED(4) :: else fi;
  if :: left[B] && undecided(B, 0) -> REACHED(5) :: else fi;
  if :: first_there -> REACHED(8) :: else fi;
  first_there = !left[A] && !left[B];
  if
  :: first_there ->
     first_shows[A] = shows[A]; first_epoch[A] = of_epoch[A];
     first_shows[B] = shows[B]; first_epoch[B] = of_epoch[B];
     left[A] = true; left[B] = true
  :: else
  fi;
  if :: left[A] -> forget(A) :: else fi;
  if :: left[B] -> forget(B) :: else fi;
  if
  :: round == ROUNDS -> viewer = GIVEN_UP; REACHED(6)
  :: else -> round++; at = t
  fi
}

proctype Viewer() {
  byte t;
  end: do
  :: atomic { viewer == BEGUN && (!left[A] || answered[A]) && (!left[B] || answered[B]) ->
       if
       :: confirmed -> shows[A] = first_shows[A]; shows[B] = first_shows[B]
       :: else ->
          t = max(from[A], from[B]);
          t = max(t, elsewhere);
          left[A] = lags(A, t);
          left[B] = lags(B, t)
       fi;
       if
       :: confirmed || !(left[A] || left[B] || asks_twice) -> settle(shows[A], shows[B])
       :: else -> ask_again(t)
       fi;
       t = 0 }
  od
}

init {
  byte k;
  atomic {
    clock[A] = 1; clock[B] = 1;
    epoch[A] = 1; epoch[B] = 1; known_epoch[A] = 1; known_epoch[B] = 1;
    left[A] = true; left[B] = true;
    if
    :: ELSEWHERE -> select(elsewhere : 0 .. CLOCK_MAX)
    :: else
    fi;
    run Shard(A); run Shard(B); run Viewer();
    for (k : 0 .. COMMITS - 1) { run Commit(k) }
    k = 0
  }
}
