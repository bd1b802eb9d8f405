/* A grant that a session keeps after its block, where client and shard share no memory: used again
 * without a message to the shard, given back when the shard sends word that another lock waits.
 *
 * Each step names what it mirrors in enact_dist/core (file:function):
 *   state/tenure.py:stays, recall, over, find   kept, recalled, over; the tenure of a token
 *   state/commits.py:commit, validate, _persisted, _apply   the end of a use at the shard
 *   shard/on_lock.py:on_acquire, _supersede, on_release   a lock that conflicts; one that is over
 *   shard/on_session.py:on_keep_alive, end, shard/shard.py:_expire, _on_break   word, and other ends
 *   client/kept.py:take, put_back, client/client.py:begin_kept   a use begins and ends
 *   client/session.py:_alive, _epoch_changed, _drop_grants   what is heard, and what is lost
 *
 * One shard, one slot, two threads: of two sessions, or of one (ONE_SESSION).  What a client knows
 * of a grant changes in one step (its mutex): in use, idle (the entry), or gone.  Word of a recall is
 * the answer to a keep-alive; it never waits for a block.
 *
 * Network: what was sent comes late, again and again, or never; an answer comes while it is waited
 * for.  What could change nothing any more is forgotten, which saves states.
 * Time: `window` of a use, and of an entry, is open while it may be believed in.  It closes at any
 * moment; a keep-alive that lists the grant opens it again, unless that is word of a recall.  The
 * shard ends a lease, a hold limit and a grace only after the windows that they stand for.
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
#define IN     2                /* in its block */
#define ENDS   3                /* has sent a Commit or a Validate */
#define DEAD   4

/* A thread. */
byte phase[2];
byte seq[2];                    /* of its newest lock */
bool fresh[2];                  /* this lock was granted by the shard, not begun from an entry */
byte token[2];                  /* the grant that it uses; 0: none, or lost */
bool old[2];                    /* what it shows its block */
bool stale[2];                  /* it was old already when the block began */
bool window[2];
bool heard[2];                  /* that another lock waits for the grant in use */

/* A session. */
byte known[2];                  /* epoch of the shard */
byte entry[2];                  /* the kept grant, between two uses; 0: none */
bool entry_old[2];
bool entry_window[2];
bool entry_heard[2];            /* never, but with a wrong edit */

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
bool word;                      /* to the session that has the grant: another lock waits for it */
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
bool over;                      /* this step ends the grant */

byte rule;
#define BROKEN(n) rule = n; assert(rule != n)
#ifdef GOAL
#define REACHED(n) if :: n == GOAL -> BROKEN(100 + n) :: else fi
#else
#define REACHED(n) skip
#endif
#define believes(t) (phase[t] == IN && window[t])
#define awaited(t, s) (phase[t] == ENDS && seq[t] == s)
#define listens(t) (phase[t] == ASKS && seq[t] == waits[t])

/* ---------------------------------------------------------------- a client */

inline drop_entry(e) {
  entry[e] = 0; entry_old[e] = false; entry_window[e] = false; entry_heard[e] = false
}

inline drop_use(t) {
  d_step { token[t] = 0; old[t] = false; stale[t] = false; window[t] = false; heard[t] = false }
}

inline release(g) { if :: (g) && (g) == held -> released = true :: else fi }

inline take(t) {
  if :: entry_heard[of(t)] -> BROKEN(13) :: else fi;
  token[t] = entry[of(t)]; old[t] = entry_old[of(t)]; window[t] = entry_window[of(t)];
  stale[t] = old[t];
  drop_entry(of(t))
}

#ifdef PUTS_BACK_RECALLED       /* what it has heard in a block is forgotten with it */
#define given_back(t) false
#else
#define given_back(t) heard[t]
#endif

inline let_go(t) {              /* a block has ended well: the grant stays, or is given back */
  if
  :: given_back(t) -> release(token[t]); REACHED(1)
  :: !given_back(t) ->
     entry[of(t)] = token[t]; entry_old[of(t)] = old[t]; entry_window[of(t)] = window[t];
     entry_heard[of(t)] = heard[t]
  fi
}

#ifdef BELIEVES_FOREVER         /* a lease is never over */
#define believed(w) true
#else
#define believed(w) w
#endif

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
        let_go(t)
     :: else
     fi
  fi
}

inline settle_use(t) {          /* what each step to another phase brings with it */
  if
  :: phase[t] == ENDS ->
     if :: sent_token[AT(t, seq[t])] != held -> forget(AT(t, seq[t])) :: else fi;
     answer[t] = 0; answer_old[t] = false
  :: else
  fi;
  if
  :: next == REST || next == DEAD ->
     drop_use(t); d_step { fresh[t] = false; grant_token[t] = 0; grant_old[t] = false }
  :: else
  fi;
  phase[t] = next; next = 0
}

proctype Client(byte t) {
  byte next;
  end: do
  :: atomic {
       if
       /* a lock begins from an entry that is believed in */
       :: phase[t] == REST && entry[of(t)] && believed(entry_window[of(t)]) && seq[t] < limit(t) ->
          take(t); seq[t]++; next = IN
       /* or by asking, also a lock of other slots, for which there is no entry */
       :: phase[t] == REST && seq[t] < limit(t) && known[of(t)] == epoch ->
          seq[t]++; fresh[t] = true; asked[AT(t, seq[t])] = true; next = ASKS
       :: phase[t] == ASKS && grant_token[t] && window[t] ->
          token[t] = grant_token[t]; old[t] = grant_old[t]; grant_token[t] = 0; grant_old[t] = false;
          next = IN
       :: phase[t] == ASKS -> release(grant_token[t]); next = REST
       /* the block ends: with writes, with reads alone, without anything */
       :: phase[t] == IN && token[t] -> send(t, false)
       :: phase[t] == IN && token[t] -> send(t, true)
       :: phase[t] == IN && token[t] && fresh[t] -> release(token[t]); next = REST
#ifndef WRITES_ALONE
       :: phase[t] == IN && token[t] && !fresh[t] && believed(window[t]) ->
          if :: stale[t] -> BROKEN(6) :: else fi;
          let_go(t); next = REST; REACHED(2)
#endif
       :: phase[t] == IN && !fresh[t] -> next = REST            /* by an exception, or lost */
       :: phase[t] == IN && !token[t] -> next = REST
       :: phase[t] == ENDS && answer[t] -> get_answer(t)
       :: phase[t] == ENDS && !answer[t] ->     /* no answer: nobody knows whether it will arrive */
#ifdef KEEPS_AFTER_UNKNOWN      /* and the entry stays */
          if :: token[t] -> let_go(t) :: else fi;
#endif
          next = REST
#if !defined(NO_DEATH) && !defined(ONE_SESSION)
       :: phase[t] != DEAD -> drop_entry(of(t)); next = DEAD
#endif
       fi;
       settle_use(t) }
#ifndef STEADY                  /* beliefs end at any moment, and locks are broken by hand */
  :: atomic { window[t] -> window[t] = false }
#endif
  od
}

#ifdef ENDING_IS_NO_USE         /* a block whose end was sent counts no more */
#define in_use(t) (token[t] == held && phase[t] == IN)
#else
#define in_use(t) (token[t] == held)
#endif
#define uses(e) (held && ((of(0) == e && in_use(0)) || (of(1) == e && in_use(1))))

inline hear(e) {                /* word that another lock waits for the grant */
  if
#ifndef RELEASES_IN_USE         /* the grant is given back at once, whatever uses it */
  :: uses(e) ->
     if :: of(0) == e && in_use(0) -> heard[0] = true :: else fi;
     if :: of(1) == e && in_use(1) -> heard[1] = true :: else fi;
     REACHED(3)
  :: !uses(e) && entry[e] == held ->
#else
  :: entry[e] == held ->
#endif
#ifndef RELEASES_AND_KEEPS      /* the entry stays */
     drop_entry(e);
#endif
     release(held); REACHED(4)
#ifndef IGNORES_UNKNOWN         /* word of a grant that the client has forgotten means nothing */
#ifdef RELEASES_IN_USE
  :: entry[e] != held -> release(held)
#else
  :: !uses(e) && entry[e] != held -> release(held); REACHED(5)
#endif
#else
  :: else
#endif
  fi
}

inline lose(t, e) {
  if
  :: of(t) == e ->
     drop_use(t);
     grant_token[t] = 0; grant_old[t] = false; answer[t] = 0; answer_old[t] = false;
     if :: phase[t] == ASKS -> asked[AT(t, seq[t])] = true :: else fi
  :: else
  fi
}

#define listed(g) (held && (g) == held && known[e] == epoch)

/* The threads that keep a session alive, and listen for it. */
proctype Session(byte e) {
  end: do
  /* EpochChanged: all is dropped before the new epoch is acknowledged */
  :: atomic { known[e] < epoch ->
       known[e] = epoch;
#ifndef KEEPS_OVER_EPOCH        /* the entry stays */
       drop_entry(e);
#endif
       lose(0, e); lose(1, e) }
  :: atomic { held && word && of(by) == e && known[e] == epoch && phase[by] != DEAD ->
       word = false; hear(e) }
#ifndef TELLS_ONCE              /* word of a recall is not repeated */
  :: atomic { held && recalled && of(by) == e && known[e] == epoch && phase[by] != DEAD -> hear(e) }
#endif
  /* what was not used for a while is given back */
  :: atomic { entry[e] -> release(entry[e]); drop_entry(e) }
#ifndef STEADY
  :: atomic { entry_window[e] -> entry_window[e] = false }
#endif
  :: atomic { listed(entry[e]) && !recalled && !entry_window[e] -> entry_window[e] = true }
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

inline forget_late(m) {         /* no copy of it can commit any more */
  if :: sent[m] && sent_token[m] == held && !awaited(m / 4, m % 4) -> forget(m) :: else fi
}

inline no_grant() {
  held = 0; by = 0; by_seq = 0; kept = false; recalled = false; released = false; word = false
}

inline grant(t) {
  numbers++;
  held = numbers; by = t; by_seq = waits[t];
  if :: listens(t) -> window[t] = true; grant_token[t] = held :: else fi;
  waits[t] = 0
}

inline settle() {               /* each step of the shard ends so */
  if
  :: over -> d_step { for (i : 1 .. 7) { forget_late(i) } i = 0; no_grant(); over = false }
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
#ifdef REVOKES_AT_ONCE          /* the shard does not wait for the client */
  :: held && kept && !bound -> over = true
#endif
  :: held && kept -> recalled = true; word = true
  :: else
  fi
}

inline reply(t, s, kind) { if :: awaited(t, s) -> answer[t] = kind; answer_old[t] = false :: else fi }

inline keep_or_end(t, s) {
  if
  :: held == sent_token[m] && !wanted -> kept = true; reply(t, s, 2)
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
           if :: kept && !awaited(t, s) -> REACHED(6) :: else fi;
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
       :: asked[m] -> on_acquire(t, s)
       :: sent[m] -> on_end(t, s)
       /* the store is done */
       :: flight == m -> flight = 0; apply(t, s); keep_or_end(t, s)
       fi;
       settle() }
  od
}

#define opened(t) (window[t] && (token[t] == held || grant_token[t] == held))
#define unbelieved (!opened(0) && !opened(1) && !(entry_window[of(by)] && entry[of(by)] == held))
#define closed(t) (known[of(t)] == epoch || (!window[t] && !entry_window[of(t)]))
#define cares(t) (seq[t] == by_seq && phase[t] != REST && phase[t] != DEAD)

inline broken(t) {              /* by force: its block is judged no longer */
  if :: token[t] == held || grant_token[t] == held -> window[t] = false :: else fi
}

inline restart() {
  if :: kept -> REACHED(7) :: else fi;
  d_step {
    for (i : 1 .. 7) { forget_late(i); asked[i] = false }
    for (i : 0 .. 1) { waits[i] = 0; top[i] = outcome[i]; validated[i] = 0 }
    i = 0; no_grant(); flight = 0; epoch++; grace = true
  }
}

proctype Shard() {
  byte i;
  end: do
  :: atomic {
       if
       :: released && !bound -> over = true; if :: kept && recalled -> REACHED(8) :: else fi
       /* the end of a lease, of the hold limit, or of the process */
       :: held && !bound && unbelieved ->
          if :: kept && recalled -> REACHED(9) :: else fi;
          over = true
       /* broken by hand */
#ifndef STEADY
       :: held && !bound ->
          broken(0); broken(1);
          if :: entry[of(by)] == held -> drop_entry(of(by)) :: else fi;
          over = true
#endif
       /* a keep-alive: its thread no longer wants it */
#ifdef KEEP_ALIVE_ENDS_KEPT     /* also a kept one: its first lock is over */
       :: held && !bound && !cares(by) -> over = true
#else
       :: held && !bound && !cares(by) && !kept -> over = true
#endif
       /* word that was lost */
       :: word -> word = false
       /* a Release, or a keep-alive, of what waits */
       :: waits[0] && !listens(0) -> waits[0] = 0
       :: waits[1] && !listens(1) -> waits[1] = 0
       :: grace && closed(0) && closed(1) -> grace = false
       :: epoch < EPOCHS -> restart()
       fi;
       settle() }
  od
}

#ifdef TELLS_ONCE
#define under_way word
#else
#define under_way recalled
#endif
#ifdef IGNORES_UNKNOWN
#define answered(e) (entry[e] == held)
#else
#define answered(e) true
#endif
/* It waits for a grant that no block uses, of a session that lives, and no word of it is under way. */
#define idle (held && kept && !flight && !uses(0) && !uses(1) && phase[by] != DEAD)
#define hopeless(t) (listens(t) && waits[t] && idle && !released && !(under_way && answered(of(by))))

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
