/* Locks over two shards beside grants that sessions keep there: no deadlock.
 *
 * Each step names what it mirrors in enact_dist/core (file:function):
 *   client/plan.py:first_asking, client/lock.py:_acquire, _advance   one shard after the other
 *   client/kept.py:take, put_back   a lock on one shard may begin from a kept grant
 *   state/tenure.py:stays, recall, over   kept, revoked, over with its use
 *   shard/on_lock.py:on_acquire, state/lock_table.py:enqueue, take_ready, remove   the queue
 *
 * A lock takes shard 0, or shard 1, or both in this order.  On one shard it may be kept afterwards,
 * and begin from what its session keeps there.  A lock over both shards asks each of them in its
 * turn, whatever its session keeps, and leaves nothing kept.  What is kept and not in use ends in
 * the step in which a lock enters the queue for it, also a lock of the same session; what is in use
 * ends with its use.  With FAR, what is not in use ends when its session has heard that a lock waits,
 * whatever its threads wait for.  Two threads of two sessions; with THREADS=3 the first two are of one session.
 */
#ifndef THREADS
#define THREADS 2
#endif
#ifndef LOCKS
#define LOCKS 3                 /* how many locks each thread begins */
#endif
#define NONE 9
#if THREADS == 3
#define of(c) ((c) / 2)
#define anybody(a) (a[0] | a[1] | a[2])
#else
#define of(c) (c)
#define anybody(a) (a[0] | a[1])
#endif

#define REST  0
#define WANTS 1                 /* takes its parts in order */
#define IN    2
byte phase[THREADS];
byte locks[THREADS];
byte need[THREADS];             /* the shards of this lock, one bit each */
byte at[THREADS];               /* the shard whose turn it is */
byte asks[THREADS];             /* waits in the queue of these */
byte has[THREADS];              /* granted to this lock, or in use by it */

byte owner[2] = NONE;           /* the session that has the grant */
bool kept[2];
#ifdef FAR
bool word[2];                   /* to the owner: another lock waits */
#endif

byte rule;
#define BROKEN(n) rule = n; assert(rule != n)
#ifdef GOAL
#define REACHED(n) if :: n == GOAL -> BROKEN(100 + n) :: else fi
#else
#define REACHED(n) skip
#endif
#define BIT(s) (1 << (s))
#define idle(s) (kept[s] && !(anybody(has) & BIT(s)))

#ifdef NO_ORDER                 /* one of them begins with the other shard */
#define shard(c) ((c) == 1 -> 1 - at[c] : at[c])
#else
#define shard(c) at[c]
#endif
#ifdef TAKES_EARLY              /* a lock over both takes what is kept at once, out of turn */
#define early(c, s) (need[c] == 3 && idle(s) && owner[s] == of(c) -> BIT(s) : 0)
#else
#define early(c, s) 0
#endif
#if defined(NEVER_REVOKES)      /* a kept grant ends with its next use only */
#define revokes(c, s) false
#elif defined(OWN_NOT_REVOKED)  /* a lock of the same session ends none */
#define revokes(c, s) (owner[s] != of(c))
#else
#define revokes(c, s) true
#endif
#ifdef HEARS_BETWEEN_LOCKS      /* the thread itself listens, once it has no lock and awaits none */
#define hears(s) (phase[owner[s]] == REST)
#else
#define hears(s) true
#endif

inline begin(c, what) { phase[c] = WANTS; need[c] = what; locks[c]++; has[c] = early(c, 0) | early(c, 1) }

inline end_part(c, s) {
  if
  :: !(has[c] & BIT(s)) -> skip
  :: (has[c] & BIT(s)) && need[c] != 3 && !(anybody(asks) & BIT(s)) -> kept[s] = true
  :: (has[c] & BIT(s)) && (need[c] == 3 || (anybody(asks) & BIT(s))) ->
     if :: kept[s] -> REACHED(5) :: else fi;
     owner[s] = NONE; kept[s] = false
  fi
}

proctype Thread(byte c) {
  end: do
  :: atomic { phase[c] == REST && locks[c] < LOCKS -> begin(c, 1) }
  :: atomic { phase[c] == REST && locks[c] < LOCKS -> begin(c, 2) }
  :: atomic { phase[c] == REST && locks[c] < LOCKS -> begin(c, 3) }
  :: atomic { phase[c] == WANTS && at[c] < 2 && (!(need[c] & BIT(shard(c))) || (has[c] & BIT(shard(c)))) -> at[c]++ }
  /* from a kept grant: the cell still holds its number */
  :: atomic { phase[c] == WANTS && at[c] < 2 && need[c] == BIT(shard(c)) && idle(shard(c)) && owner[shard(c)] == of(c) ->
       has[c] = has[c] | need[c]; REACHED(1) }
  /* or by asking */
  :: atomic { phase[c] == WANTS && at[c] < 2 && (need[c] & BIT(shard(c))) && !((asks[c] | has[c]) & BIT(shard(c))) &&
              !(need[c] != 3 && idle(shard(c)) && owner[shard(c)] == of(c)) ->
       asks[c] = asks[c] | BIT(shard(c));
       if
       :: idle(shard(c)) && revokes(c, shard(c)) ->
          if :: owner[shard(c)] == of(c) -> REACHED(2) :: else -> REACHED(4) fi;
#ifdef FAR
          word[shard(c)] = true
#else
          owner[shard(c)] = NONE; kept[shard(c)] = false
#endif
       :: else
       fi }
  :: atomic { phase[c] == WANTS && at[c] == 2 -> phase[c] = IN; if :: need[c] == 3 -> REACHED(3) :: else fi }
  :: atomic { phase[c] == IN ->
       end_part(c, 0); end_part(c, 1);
       phase[c] = REST; need[c] = 0; at[c] = 0; has[c] = 0 }
  od
}

proctype Shard(byte s) {
  byte c;
  end: do
#ifdef FAR
  :: atomic { word[s] && idle(s) && hears(s) -> owner[s] = NONE; kept[s] = false; REACHED(6) }
#endif
  :: atomic { owner[s] == NONE && (asks[0] & BIT(s)) -> c = 0; goto grant }
  :: atomic { owner[s] == NONE && (asks[1] & BIT(s)) -> c = 1; goto grant }
#if THREADS == 3
  :: atomic { owner[s] == NONE && (asks[2] & BIT(s)) -> c = 2; goto grant }
#endif
  od;
  grant:
    atomic {
#ifdef FAR
      word[s] = false;
#endif
      owner[s] = of(c); asks[c] = asks[c] & ~BIT(s); has[c] = has[c] | BIT(s); c = 0 };
    goto end
}

proctype Judge() {
  end: do
#if THREADS == 3
  :: atomic { timeout && phase[2] == WANTS -> BROKEN(12) }
#endif
  :: atomic { timeout && (phase[0] == WANTS || phase[1] == WANTS) -> BROKEN(12) }
  od
}

init {
  byte c;
  atomic {
    for (c : 0 .. THREADS - 1) { run Thread(c) }
    c = 0;
    run Shard(0); run Shard(1); run Judge()
  }
}
