/* A grant that a session keeps after its block, on one host: used again without a message to the
 * shard, revoked without a message to the client.
 *
 * Each step names what it mirrors in enact_dist/core (file:function):
 *   state/tenure.py:stays, recall, over, find   kept, recalled, over; the tenure of a token
 *   state/commits.py:commit, validate, _persisted, _apply   the end of a use at the shard
 *   shard/on_lock.py:on_acquire, _supersede, on_release   a lock that conflicts; one that is over
 *   shard/on_session.py:on_keep_alive, end, shard/shard.py:_on_tick, _expire, _on_break   other ends
 *   client/kept.py:take, put_back   where a use begins and ends
 *   client/session.py:_epoch_changed, _drop_grants, _alive, client/lock.py:_gives_up   what is lost
 *
 * One shard, one slot, two threads: of two sessions, or of one (ONE_SESSION).  A session has a file
 * of shared memory.  While a kept grant lives, a cell of the file holds its number; the shard clears
 * the cell first, whatever ends the grant.  A use holds the kernel's lock on the byte of that number
 * (the mark); the shard asks the kernel about it and never takes it.  The threads of a session share
 * one descriptor, so to the kernel their marks are one.
 *
 * Network: what was sent comes late, again and again, or never; an answer comes while it is waited
 * for.  What could change nothing any more is forgotten, which saves states.
 * Time: `window` of a use, and of an entry, is open while it may be believed in.  It closes at any
 * moment, and opens again if the shard lists this very grant.  The shard ends a lease, the hold
 * limit of a grant, and a grace only after the windows that they stand for.
 * Versions: `old` says of a copy of the data that a newer version was committed since.
 */
#ifndef LOCKS0
#define LOCKS0 2                /* how many locks the first thread begins, */
#endif
#ifndef LOCKS1
#define LOCKS1 1                /* and the second one; at most 3 */
#endif
#ifndef EPOCHS
#define EPOCHS 1
#endif
#define limit(t) ((t) == 0 -> LOCKS0 : LOCKS1)
#ifdef ONE_SESSION
#define of(t) 0
#else
#define of(t) (t)
#endif

#define REST   0                /* between two locks */
#define ASKS   1                /* has sent an Acquire */
#define MARKED 2                /* has taken the entry and the mark, has not looked at the cell */
#define LOOKED 3                /* the cell held its number; has not looked at its belief */
#define IN     4                /* in its block */
#define ENDS   5                /* has sent a Commit or a Validate */
#define LETGO  6                /* has given the mark back, has not looked at the cell */
#define DEAD   7

/* A thread. */
byte phase[2];
byte seq[2];                    /* of its newest lock */
bool fresh[2];                  /* this lock was granted by the shard, not begun from an entry */
byte token[2];                  /* the grant that it uses; 0: none, or lost */
bool old[2];                    /* what it shows its block */
bool stale[2];                  /* it was old already when the thread looked at the cell */
bool window[2];
byte mark[2];                   /* the byte that it has locked; 0: none */

/* A session. */
byte known[2];                  /* epoch of the shard */
byte entry[2];                  /* the kept grant, between two uses; 0: none */
bool entry_old[2];
bool entry_window[2];
byte cells[2];                  /* the numbers in the cells of its file, one bit each */
byte marks[2];                  /* the bytes locked in it, one bit each */

/* Messages: of lock s of thread t at AT(t, s). */
#define AT(t, s) ((t) * 4 + (s))
bool asked[8];                  /* an Acquire that may still enter the queue */
bool sent[8];                   /* a Commit, */
bool reads[8];                  /* or a Validate */
byte sent_token[8];
bool sent_old[8];
bool done[8];                   /* this commit was applied */
byte grant_token[2];            /* Granted, to be taken; 0: none */
bool grant_old[2];
byte answer[2];                 /* 0: none, 1: well and over, 2: well and kept, 3: Fenced */
bool answer_old[2];
bool released;                  /* a Release of the grant that is held */

/* The shard. */
byte epoch = 1;
bool grace;
byte held;                      /* number of the grant; 0: none */
byte by;                        /* its origin: thread and seq of its Acquire */
byte by_seq;
bool kept;
bool recalled;
byte flight;                    /* the commit that the store works on, as AT(t, s); 0: none */
byte waits[2];                  /* seq of the lock in the queue; 0: none */
byte top[2];
byte outcome[2];                /* seq of the newest commit, */
byte validated[2];              /* and of the newest reads found intact */
byte numbers;
byte busy;                      /* 1: between the cell and the mark; 2: between the mark and the end */
bool over;                      /* this step ends the grant */
#ifdef NUMBERS_START_AGAIN
byte start;                     /* grants of earlier epochs */
#endif

byte rule;
#define BROKEN(n) rule = n; assert(rule != n)
#ifdef GOAL
#define REACHED(n) if :: n == GOAL -> BROKEN(100 + n) :: else fi
#else
#define REACHED(n) skip
#endif
#define BIT(n) (1 << (n))
#define believes(t) (phase[t] == IN && window[t])
#define awaited(t, s) (phase[t] == ENDS && seq[t] == s)
#define listens(t) (phase[t] == ASKS && seq[t] == waits[t])
#ifdef NUMBERS_START_AGAIN      /* numbers of cells and marks begin again with each epoch */
#define number(g) ((g) > start -> (g) - start : (g))
#else
#define number(g) (g)
#endif
#define in_cell(t) (cells[of(t)] & BIT(number(token[t])))
#define in_use (marks[of(by)] & BIT(number(held)))

/* ---------------------------------------------------------------- a client */

inline drop_entry(e) { entry[e] = 0; entry_old[e] = false; entry_window[e] = false }

inline drop_use(t) { d_step { token[t] = 0; old[t] = false; stale[t] = false; window[t] = false } }

inline take(t) {
  token[t] = entry[of(t)]; old[t] = entry_old[of(t)]; window[t] = entry_window[of(t)];
  drop_entry(of(t));
#ifndef USES_WITHOUT_MARK       /* a use begins by the cell alone */
  mark[t] = number(token[t]); marks[of(t)] = marks[of(t)] | BIT(mark[t]);
#endif
  next = MARKED
}

inline put_back(t) {
  entry[of(t)] = token[t]; entry_old[of(t)] = old[t]; entry_window[of(t)] = window[t]
}

inline send(t, read) {
  sent[AT(t, seq[t])] = true; reads[AT(t, seq[t])] = read;
  sent_token[AT(t, seq[t])] = token[t]; sent_old[AT(t, seq[t])] = old[t];
  next = ENDS
}

inline forget(m) { sent[m] = false; reads[m] = false; sent_token[m] = 0; sent_old[m] = false; done[m] = false }

inline get_answer(t) {
  next = REST;
  if
  :: answer[t] == 3 -> skip
  :: else ->
     if :: !reads[AT(t, seq[t])] && !done[AT(t, seq[t])] -> BROKEN(5) :: else fi;
     if
     :: answer[t] == 2 && token[t] ->
#ifndef SHOWS_OLD               /* its own commit does not change what it shows next */
        old[t] = answer_old[t];
#endif
        next = LETGO
     :: else
     fi
  fi
}

#ifdef LEAVES_MARK              /* a use without an answer does not give its mark back */
#define leaves_mark (phase[t] == ENDS && !answer[t])
#else
#define leaves_mark false
#endif

inline settle_use(t) {          /* what each step to another phase brings with it */
  if
  :: mark[t] && (next == LETGO || next == REST || next == DEAD) && !leaves_mark ->
     marks[of(t)] = marks[of(t)] & ~BIT(mark[t]); mark[t] = 0
  :: else
  fi;
#ifndef NO_RELEASES
  if :: says && token[t] && token[t] == held -> released = true :: else fi;
#endif
  if
  :: phase[t] == ENDS ->
     if :: sent_token[AT(t, seq[t])] != held -> forget(AT(t, seq[t])) :: else fi;
     answer[t] = 0; answer_old[t] = false
  :: else
  fi;
  if :: next == REST || next == DEAD -> drop_use(t); d_step { fresh[t] = false; grant_token[t] = 0; grant_old[t] = false } :: else fi;
  phase[t] = next; next = 0; says = false
}

proctype Client(byte t) {
  byte next;
  bool says;                    /* with a Release, which may be lost */
  end: do
  :: atomic {
       if
       /* a lock begins from an entry: the mark, the cell, the belief */
       :: phase[t] == REST && entry[of(t)] && seq[t] < limit(t) -> take(t)
       :: phase[t] == MARKED && token[t] && in_cell(t) -> stale[t] = old[t]; next = LOOKED
       :: phase[t] == MARKED && token[t] && !in_cell(t) ->
#ifdef NO_LOOK_BEFORE
          BROKEN(13);
#endif
          says = true; next = REST; REACHED(1)
       :: phase[t] == MARKED && !token[t] -> next = REST        /* lost with its epoch */
#ifdef BELIEVES_FOREVER         /* a use begins though the lease may be over */
       :: phase[t] == LOOKED && token[t] -> seq[t]++; next = IN
#else
       :: phase[t] == LOOKED && window[t] -> seq[t]++; next = IN
#endif
       :: phase[t] == LOOKED && !window[t] -> next = REST
       /* or by asking, also a lock of other slots, for which there is no entry */
       :: phase[t] == REST && seq[t] < limit(t) && known[of(t)] == epoch ->
          seq[t]++; fresh[t] = true; asked[AT(t, seq[t])] = true; next = ASKS
       :: phase[t] == ASKS && grant_token[t] && window[t] ->
          token[t] = grant_token[t]; old[t] = grant_old[t]; grant_token[t] = 0; grant_old[t] = false;
          next = IN
       :: phase[t] == ASKS -> token[t] = grant_token[t]; says = true; next = REST
       /* the block ends: with writes, with reads alone, without anything */
       :: phase[t] == IN && token[t] -> send(t, false)
       :: phase[t] == IN && token[t] && fresh[t] -> send(t, true)
       :: phase[t] == IN && token[t] && fresh[t] -> says = true; next = REST
       :: phase[t] == IN && token[t] && !fresh[t] ->
          if :: stale[t] -> BROKEN(6) :: else fi;
          next = LETGO
       :: phase[t] == IN && !token[t] -> next = REST
       :: phase[t] == ENDS && answer[t] -> get_answer(t)
       :: phase[t] == ENDS && !answer[t] ->     /* no answer: nobody knows whether it will arrive */
#ifdef KEEPS_AFTER_UNKNOWN      /* and the entry stays */
          next = (token[t] -> LETGO : REST)
#else
          next = REST
#endif
#ifdef NO_RELEASES              /* and no look at the cell, after which one would be sent */
       :: phase[t] == LETGO && token[t] -> put_back(t); next = REST
#else
       :: phase[t] == LETGO && token[t] && !in_cell(t) -> says = true; next = REST; REACHED(2)
       :: phase[t] == LETGO && token[t] && in_cell(t) -> put_back(t); next = REST
#endif
       :: phase[t] == LETGO && !token[t] -> next = REST
#if !defined(NO_DEATH) && !defined(ONE_SESSION)
       :: phase[t] != DEAD -> drop_entry(of(t)); next = DEAD    /* the kernel gives its marks back */
#endif
       fi;
       settle_use(t) }
#ifndef STEADY                  /* beliefs end at any moment, and locks are broken by hand */
  :: atomic { window[t] -> window[t] = false }
#endif
  od
}

inline lose(t, e) {
  if
  :: of(t) == e ->
#ifdef DROPS_ENTRIES_ALONE      /* a taken entry, whose use has not begun yet, stays */
     if :: phase[t] == MARKED || phase[t] == LOOKED :: else -> drop_use(t) fi;
#else
     drop_use(t);
#endif
     grant_token[t] = 0; grant_old[t] = false; answer[t] = 0; answer_old[t] = false;
     if :: phase[t] == ASKS -> asked[AT(t, seq[t])] = true :: else fi
  :: else
  fi
}

#define listed(g) (held && (g) == held && known[e] == epoch)

/* The thread that keeps a session alive. */
proctype Session(byte e) {
  end: do
  /* EpochChanged: all is dropped before the new epoch is acknowledged */
  :: atomic { known[e] < epoch ->
       known[e] = epoch;
#ifndef KEEPS_OVER_EPOCH        /* the entry stays */
       drop_entry(e);
#endif
       lose(0, e); lose(1, e) }
#ifndef STEADY
  :: atomic { entry_window[e] -> entry_window[e] = false }
#endif
  :: atomic { listed(entry[e]) && !entry_window[e] -> entry_window[e] = true }
  :: atomic { of(0) == e && listed(token[0]) && !window[0] -> window[0] = true }
  :: atomic { of(1) == e && listed(token[1]) && !window[1] -> window[1] = true }
  od
}

/* ---------------------------------------------------------------- the shard */

#ifdef IN_FLIGHT_ENDS           /* what the store works on may end before */
#define bound false
#else
#define bound (flight != 0)
#endif
#ifdef KEEPS_WITH_WAITER        /* a grant is kept, whoever waits */
#define wanted false
#else
#define wanted (waits[0] || waits[1])
#endif
#ifdef NO_SEQ_CHECK             /* under a kept grant any seq may commit */
#define in_turn true
#else
#define in_turn (s > top[t] || (!kept && t == by && s == by_seq))
#endif
#ifdef LATE_READS               /* a Validate of the lock that was granted counts, however late */
#define late_reads reads[m]
#else
#define late_reads false
#endif
#ifdef SETS_CELL_AGAIN          /* at each commit, though the grant was recalled meanwhile */
#define sets_cell true
#else
#define sets_cell !kept
#endif

inline clear_cell() { cells[of(by)] = cells[of(by)] & ~BIT(number(held)) }

inline forget_late(m) {         /* no copy of it can commit any more */
  if :: sent[m] && sent_token[m] == held && !awaited(m / 4, m % 4) -> forget(m) :: else fi
}

inline no_grant() { held = 0; by = 0; by_seq = 0; kept = false; recalled = false; released = false }

inline grant(t) {
  numbers++;
  held = numbers; by = t; by_seq = waits[t];
  if :: listens(t) -> window[t] = true; grant_token[t] = held :: else fi;
  waits[t] = 0
}

inline settle() {               /* each step of the shard ends so */
  if
  :: over ->
     d_step { clear_cell(); for (i : 1 .. 7) { forget_late(i) } i = 0; no_grant(); over = false }
  :: else
  fi;
  if
  :: !held && !grace && waits[0] -> grant(0)
  :: !held && !grace && waits[1] -> grant(1)
  :: else
  fi
}

inline raise_top(t, s) {        /* an Acquire up to it is stale */
  if
  :: s > top[t] -> d_step { top[t] = s; for (i : 1 .. s) { asked[AT(t, i)] = false } i = 0 }
  :: else
  fi
}

inline on_acquire(t, s) {
  raise_top(t, s);
  waits[t] = s;
  if
#ifdef SUPERSEDES_KEPT          /* a newer lock of a thread ends its older ones, kept ones, too */
  :: held && !bound && t == by && s > by_seq -> over = true
#else
  :: held && !kept && !bound && t == by && s > by_seq -> over = true
#endif
#ifdef MARK_BEFORE_CELL
  :: held && kept -> busy = (bound || in_use -> 3 : 4)
#else
  :: held && kept -> clear_cell(); busy = 1     /* and then the mark */
#endif
  :: else
  fi
}

inline reply(t, s, kind) { if :: awaited(t, s) -> answer[t] = kind; answer_old[t] = false :: else fi }

inline keep_or_end(t, s) {
  if
  :: held == sent_token[m] && !wanted ->
     if :: sets_cell -> cells[of(by)] = cells[of(by)] | BIT(number(held)) :: else fi;
     kept = true; reply(t, s, 2)
  :: else -> over = held == sent_token[m]; reply(t, s, 1)
  fi
}

inline apply(t, s) {
  if :: done[m] -> BROKEN(16) :: else fi;
  d_step {
    for (i : 0 .. 1) {
      old[i] = token[i] != 0; entry_old[i] = entry[i] != 0;
      grant_old[i] = grant_token[i] != 0; answer_old[i] = answer[i] == 2
    }
    for (i : 1 .. 7) { sent_old[i] = sent[i] }
    i = 0; done[m] = true
  };
  if :: s > outcome[t] -> outcome[t] = s :: else fi
}

inline on_end(t, s) {           /* a Commit or a Validate */
  if
  :: (reads[m] -> validated[t] == s && !late_reads : outcome[t] == s) ->        /* again: recalled or not */
     if
     :: held && held == sent_token[m] && kept -> reply(t, s, 2)
     :: reply(t, s, 1)           /* to an Outcome, which does not say it; or it is over */
     fi
  :: flight == m -> skip
  :: else ->
     if
     :: !held || held != sent_token[m] || !(in_turn || late_reads) -> reply(t, s, 3)
     :: held && held == sent_token[m] && (in_turn || late_reads) && !bound ->
        raise_top(t, s);
        if
        :: reads[m] -> validated[t] = s; keep_or_end(t, s)
        :: else ->
           if :: sent_old[m] -> BROKEN(2) :: else fi;
           if :: kept && !awaited(t, s) -> REACHED(3) :: else fi;
           flight = m
        fi
     :: else
     fi
  fi
}

/* Acquire, Commit and Validate, in time, late or again. */
proctype Arrivals(byte t; byte s) {
  byte m = AT(t, s);
  byte i;
  end: do
  :: atomic {
       if
       :: !busy && asked[m] -> on_acquire(t, s)
       :: !busy && sent[m] -> on_end(t, s)
       /* the store is done */
       :: !busy && flight == m -> flight = 0; apply(t, s); keep_or_end(t, s)
       fi;
       settle() }
  od
}

#define opened(t) (window[t] && (token[t] == held || grant_token[t] == held))
#define unbelieved (!opened(0) && !opened(1) && !(entry_window[of(by)] && entry[of(by)] == held))
#define closed(t) (known[of(t)] == epoch || (!window[t] && !entry_window[of(t)]))
#define cares(t) (seq[t] == by_seq && phase[t] != REST && phase[t] != DEAD)

inline broken(t) {              /* by force: its block is judged no longer */
  if :: (token[t] == held && phase[t] != MARKED) || grant_token[t] == held -> window[t] = false :: else fi
}

inline restart() {              /* cells stay as they were, marks are their clients' */
  if :: kept -> REACHED(7) :: else fi;
  d_step {
    for (i : 1 .. 7) { forget_late(i); asked[i] = false }
    for (i : 0 .. 1) { waits[i] = 0; top[i] = outcome[i]; validated[i] = 0 }
    i = 0; no_grant(); flight = 0; epoch++; grace = true;
#ifdef NUMBERS_START_AGAIN
    start = numbers
#endif
  }
}

proctype Shard() {
  byte i;
  end: do
  :: atomic {
       if
       /* somebody waits for the kept grant: its cell is cleared, now the mark */
#if defined(MARK_BEFORE_CELL)   /* 3: it was held, 4: it was not */
       :: busy == 3 -> clear_cell(); recalled = true; busy = 0
       :: busy == 4 -> over = true; busy = 0
#elif defined(REVOKES_IN_USE)   /* the mark is not asked about */
       :: busy == 1 -> over = !bound; busy = 0
#else
       :: busy == 1 && (bound || in_use) -> recalled = true; busy = 0; REACHED(4)
       :: busy == 1 && !bound && !in_use ->
          if :: waits[by] -> REACHED(8) :: else -> REACHED(5) fi;
          over = true; busy = 0
#endif
       :: !busy && released && !bound -> over = true
       /* a tick: the mark of what was recalled; the end is another step */
#ifndef NO_REPAIR
       :: !busy && recalled && !bound && !in_use -> busy = 2
#endif
       :: busy == 2 -> over = true; busy = 0; REACHED(6)
       /* the end of a lease, of the hold limit, or of the process, whatever the mark says */
       :: !busy && held && !bound && unbelieved ->
          if :: kept && in_use -> REACHED(9) :: else fi;
          over = true
       /* broken by hand */
#ifndef STEADY
       :: !busy && held && !bound ->
#ifdef BREAKS_SILENTLY          /* and the cell stays as it was */
          broken(0); broken(1); no_grant()
#else
          broken(0); broken(1); over = true
#endif
#endif
       /* a keep-alive: its thread no longer wants it */
#ifdef KEEP_ALIVE_ENDS_KEPT     /* also a kept one: its first lock is over */
       :: !busy && held && !bound && !cares(by) -> over = true
#else
       :: !busy && held && !bound && !cares(by) && !kept -> over = true
#endif
       /* a Release, or a keep-alive, of what waits */
       :: waits[0] && !listens(0) -> waits[0] = 0
       :: waits[1] && !listens(1) -> waits[1] = 0
       :: grace && closed(0) && closed(1) -> grace = false
       :: !busy && epoch < EPOCHS -> restart()
       fi;
       settle() }
  od
}

#define uses(t) ((token[t] == held || mark[t] == number(held)) && phase[t] >= MARKED && phase[t] <= LETGO)
#ifdef NO_REPAIR                /* the marks of recalled grants are not asked about again */
#define will_end released
#else
#define will_end (recalled && !in_use)
#endif
/* It waits for a kept grant that nobody uses, and nothing but the end of the lease would end it. */
#define hopeless(t) (listens(t) && waits[t] && held && kept && !busy && !flight && !uses(0) && !uses(1) && !(will_end))

proctype Judge() {
  end: do
  :: atomic { believes(0) && believes(1) -> BROKEN(7) }
  :: atomic { hopeless(0) || hopeless(1) -> BROKEN(12) }
  od
}

init {
  byte s;
  atomic {
    known[0] = 1; known[1] = 1;
    run Client(0); run Client(1); run Session(0);
#ifndef ONE_SESSION
    run Session(1);
#endif
    for (s : 1 .. LOCKS0) { run Arrivals(0, s) }
    for (s : 1 .. LOCKS1) { run Arrivals(1, s) }
    s = 0;
    run Shard(); run Judge()
  }
}
