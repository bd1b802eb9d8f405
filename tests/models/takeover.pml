/* Two daemons of one shard whose rows are in a replicated database: who writes, who answers, who is believed.
 *
 * Each step names what it mirrors in enact_dist/core (file:function):
 *   failover/lease.py:confirmed, holds, kept_ns   the lease of the daemon that serves
 *   failover/lease.py:passing   the check where answers leave
 *   failover/lease.py:is_free, was_away, waited_ns   the daemon that stands by
 *   failover/lease.py:after_break   what became of a batch whose connection broke
 *   state/sessions.py:__init__, in_grace, end_grace_if_all_acknowledged   the grace and its two ends
 *   shard/on_session.py:on_hello, on_keep_alive   hello in a new epoch; keep-alive
 *   state/grants.py:grant_ready, shard/shard.py:_expire   grant, and the end of a client's lease
 *   client/session.py:_epoch_changed, _drop_grants   what a client does about a new epoch
 * What the database does is as in enact_dist/verify/takeover/database.py, statements and their order
 * as in enact_dist/link/postgres (line.py, medium.py, standby.py, opening.py).
 *
 * Database: a statement is on its way, executed on the primary, confirmed once the copy has it, and
 * answered.  A connection breaks at any moment: what was on its way may still come later.  A failover
 * goes on with what the copy has.  A daemon may stay with the old primary, which confirms no more.
 * Clocks: each span is measured wrong by up to DRIFT.  A lease may seem longer to its holder, and
 * shorter to the daemon that waits for its end.  A client's `window` is as in grace.pml: it closes at
 * any moment, and a grace that ends by time has outlasted the windows from before it.
 */
#ifndef EPOCHS
#define EPOCHS 2
#endif
#ifndef BATCHES
#define BATCHES 1
#endif
#ifndef BEATS
#define BEATS 3                 /* how far renewals go; batches and takeovers go further */
#endif
#ifndef CLIENTS
#define CLIENTS 2
#endif
#ifndef LATE
#define LATE 1                  /* a statement comes although its connection broke */
#endif
#define DAEMONS 2
#define NOBODY 9

#define LEASE 2
#define DRIFT 1
#ifdef KEEPS_WHOLE_LEASE        /* the holder counts its lease without a margin for drift */
#define KEPT LEASE
#define LONG (LEASE + 1)
#else
#define KEPT (LEASE - DRIFT)
#define LONG LEASE              /* spans count up to here */
#endif
#ifdef WAITS_NO_MARGIN          /* so does the standby */
#define WAITED LEASE
#else
#define WAITED (LEASE + DRIFT)
#endif

/* The row of the shard at the primary, and what the copy has of it. */
byte epoch = 1, batch, beat;
bool given_back;
byte kept_epoch = 1, kept_batch, kept_beat;
bool kept_given_back;

#define BATCH 1
#define BEAT 2
#define BELIEF 3                /* a beat, so that a batch that stands is believed */
#define TAKE 4
byte late_kind, late_epoch, late_number;    /* a statement whose connection broke on its way */

/* A daemon.  While it stands by, `its_epoch` and `number` are the epoch and the beat that it saw. */
#define LOOKS 0
#define WATCHES 1
#define TAKES 2
#define SERVES 3
#define NONE 0
#define SENT 1
#define EXECUTED 2
#define CONFIRMED 3
#define REFUSED 4
#define WARNED 5                /* the wait for the copy was cancelled */
byte mode[DAEMONS];
byte its_epoch[DAEMONS];
byte number[DAEMONS];           /* its newest batch that is confirmed */
byte kind[DAEMONS];
byte stage[DAEMONS];            /* of its statement */
byte age[DAEMONS];              /* since the statement was sent */
byte since[DAEMONS];            /* since its lease began; since it saw the row change */
bool unsure[DAEMONS];           /* a batch's connection broke */
bool elsewhere[DAEMONS];        /* it is connected to a primary that is none any more */
bool saw_free[DAEMONS];         /* the row was given back */
bool grace[DAEMONS];
byte holder[DAEMONS];           /* of its lock */
#ifdef CHECKS_FIRST
bool checked[DAEMONS];
#endif

/* A client. */
byte known[2];                  /* epoch */
bool has[2];                    /* a grant, in its own eyes */
byte window[2];                 /* 0: closed, 1: open, 2: open since before the grace */

byte shown;                     /* ghost: the newest batch that a client was told or shown */
byte faults;                    /* so far, where they are counted */

byte rule;
#define BROKEN(n) rule = n; assert(rule != n)
#ifdef GOAL
#define REACHED(n) if :: n == GOAL -> BROKEN(100 + n) :: else fi
#else
#define REACHED(n) skip
#endif

#ifdef FAULTS                   /* so many, and then all must become well */
#define fault (faults < FAULTS)
#define FAULT faults++
#define BELIEFS (BEATS + FAULTS)
/* It can serve, and so it renews in time. */
#define renews(d) ((serves(d) || stage[d] == EXECUTED || stage[d] == CONFIRMED) && \
                   its_epoch[d] == epoch && !elsewhere[d])
#else
#define fault true
#define FAULT skip
#define BELIEFS BEATS
#define renews(d) false
#endif
#define serves(d) (mode[d] == SERVES)
#define idle(d) (stage[d] == NONE && !unsure[d] && !elsewhere[d])
#define measures(d) (since[d] < LONG && (mode[d] == WATCHES || serves(d)))
#define ages(d) (age[d] < LONG && stage[d] != NONE)
#define believes(c) (has[c] && window[c])
#define holds(d) (since[d] < KEPT + DRIFT)

#ifdef ANSWERS_UNCHECKED        /* answers go out whether the lease holds or not */
#define may_answer(d) serves(d)
#else
#ifdef CHECKS_FIRST             /* the lease is checked when a question comes, not when its answer leaves */
#define may_answer(d) (serves(d) && checked[d])
#else
#define may_answer(d) (serves(d) && holds(d))
#endif
#endif
#ifdef NO_FENCE                 /* a batch is written although another daemon has the shard */
#define fence(e, n) true
#else
#ifdef NO_NUMBER                /* the fence does not name the batch before */
#define fence(e, n) (epoch == e)
#else
#define fence(e, n) (epoch == e && batch == n - 1)
#endif
#endif
#ifdef TAKES_BLINDLY            /* a takeover does not name the row that the standby saw */
#define as_seen(e, n) true
#else
#define as_seen(e, n) (epoch == e && beat == n)
#endif
#ifdef TAKES_ELSEWHERE          /* a takeover goes over another connection than the looks */
#define may_take(d) true
#else
#define may_take(d) !elsewhere[d]
#endif

/* A statement at the primary: `executed` says whether its condition held. */
byte k, e, n;
bool executed;
inline execute() {
  executed = false;
  if
  :: k == BATCH && fence(e, n) ->
     if :: e != epoch -> BROKEN(11) :: else fi;
     if :: batch >= n -> BROKEN(16) :: else fi;
     batch = n; beat++; executed = true
  :: (k == BEAT || k == BELIEF) && epoch == e && beat < (k == BEAT -> BEATS : BELIEFS) -> beat++; executed = true
  :: k == TAKE && as_seen(e, n) && epoch < EPOCHS ->
     epoch++; beat++; given_back = false; executed = true
  :: else -> if :: k == BATCH && epoch > e -> REACHED(10) :: else fi
  fi
}

inline forget() { k = 0; e = 0; n = 0; executed = false }

inline nothing_sent(d) { kind[d] = 0; stage[d] = NONE; age[d] = 0 }

/* It ends, or looks anew: as a standby that has seen nothing. */
inline looks(d) {
  nothing_sent(d);
  mode[d] = LOOKS; its_epoch[d] = 0; number[d] = 0; since[d] = 0;
  unsure[d] = false; saw_free[d] = false; grace[d] = false; holder[d] = NOBODY;
#ifdef CHECKS_FIRST
  checked[d] = false
#endif
}

inline send(d, k) { kind[d] = k; stage[d] = SENT; age[d] = 0 }

/* A connection is lost, and with it the answer to what was sent. */
inline lose(d) {
  elsewhere[d] = false;
  if
  :: serves(d) && (kind[d] == BATCH || kind[d] == BELIEF) -> unsure[d] = true; nothing_sent(d)
  :: serves(d) && kind[d] == BEAT -> nothing_sent(d)
  :: serves(d) && stage[d] == NONE -> skip
#ifdef COUNTS_ON                /* a standby does not count anew after it had lost the database */
  :: mode[d] == WATCHES -> skip
  :: !serves(d) && mode[d] != WATCHES -> looks(d)
#else
  :: !serves(d) -> looks(d)
#endif
  fi
}

inline confirmed(d) {
#ifdef FROM_THE_ANSWER          /* the lease counts from when its confirmation came */
  age[d] = 0;
#endif
  if :: !holds(d) && age[d] < KEPT -> REACHED(6) :: else fi;
  if :: age[d] < since[d] -> since[d] = age[d] :: else fi
}

inline serve(d) {
  mode[d] = SERVES; since[d] = age[d]; saw_free[d] = false; holder[d] = NOBODY;
  window[0] = (window[0] -> 2 : 0); window[1] = (window[1] -> 2 : 0);
#ifdef NO_GRACE                 /* a daemon that has taken a shard over grants at once */
  grace[d] = false;
#else
  grace[d] = true;
#endif
  nothing_sent(d)
}

proctype Daemon(byte d) {
  end: do
  /* it stands by */
  :: atomic { !elsewhere[d] && (mode[d] == LOOKS || (mode[d] == WATCHES && (its_epoch[d] != epoch || number[d] != beat))) ->
       mode[d] = WATCHES; its_epoch[d] = epoch; number[d] = beat; since[d] = 0; saw_free[d] = given_back }
  :: atomic { mode[d] == WATCHES && may_take(d) && (saw_free[d] || since[d] + DRIFT >= WAITED) &&
              epoch < EPOCHS && !renews(1 - d) ->
       if :: saw_free[d] && since[d] == 0 -> REACHED(11) :: else fi;
       elsewhere[d] = false;
       mode[d] = TAKES; since[d] = 0; send(d, TAKE) }
  :: atomic { mode[d] == TAKES && stage[d] == CONFIRMED && epoch == its_epoch[d] -> serve(d) }
#ifdef SERVES_EARLY             /* a takeover serves before the copy has its epoch */
  :: atomic { mode[d] == TAKES && stage[d] == EXECUTED -> serve(d) }
#endif
#ifndef GIVES_UP                /* a standby that came too late looks no more */
  :: atomic { mode[d] == TAKES && (stage[d] == REFUSED || (stage[d] == CONFIRMED && epoch != its_epoch[d])) ->
       REACHED(4); looks(d) }
#endif
  /* it serves: batches, renewals, and what came of them */
  :: atomic { serves(d) && idle(d) && number[d] < BATCHES &&
              (CLIENTS == 0 || (holder[d] != NOBODY && has[holder[d]] && known[holder[d]] == its_epoch[d])) -> send(d, BATCH) }
  :: atomic { serves(d) && stage[d] == NONE && !elsewhere[d] && beat < BEATS && since[d] -> send(d, BEAT) }
  :: atomic { serves(d) && stage[d] == CONFIRMED ->
       confirmed(d);
       if
       :: kind[d] == BATCH -> number[d]++
       :: kind[d] == BELIEF -> number[d]++; REACHED(1)
       :: else
       fi;
       nothing_sent(d) }
  :: atomic { serves(d) && stage[d] == REFUSED && kind[d] == BATCH -> unsure[d] = true; nothing_sent(d) }
  :: atomic { serves(d) && stage[d] == REFUSED && kind[d] != BATCH -> REACHED(5); looks(d) }
#ifndef NEVER_ASKS              /* a daemon does not ask what became of a batch */
  :: atomic { unsure[d] && stage[d] == NONE && !elsewhere[d] ->
       if
       :: epoch == its_epoch[d] && batch == number[d] + 1 ->
#ifdef BELIEVES_AT_ONCE         /* a batch that a new connection shows counts as confirmed */
          number[d]++;
#else
          send(d, BELIEF);
#endif
          unsure[d] = false
       :: epoch == its_epoch[d] && batch == number[d] -> unsure[d] = false; send(d, BATCH); REACHED(2)
       :: else -> looks(d)
       fi }
#endif
  /* the database warned: a confirmation is none */
  :: atomic { stage[d] == WARNED ->
#ifdef IGNORES_WARNINGS
       stage[d] = CONFIRMED
#else
       looks(d)
#endif
     }
  od
}

/* Its answers: each leaves only while the lease holds. */
proctype Answers(byte d) {
  byte c;
  end: do
#ifdef CHECKS_FIRST
  :: atomic { serves(d) && holds(d) && !checked[d] -> checked[d] = true }
#endif
  /* a view, or that a lock is committed */
  :: atomic { may_answer(d) && number[d] != shown ->
       if
       :: number[d] < shown -> BROKEN(6)
       :: else -> shown = number[d]
       fi }
  od
}

proctype Client(byte c; byte d) {
  end: do
  /* EpochChanged, hello */
  :: atomic { may_answer(d) && known[c] < its_epoch[d] ->
       known[c] = its_epoch[d]; has[c] = false;
       if :: grace[d] && known[0] == known[1] -> grace[d] = false; REACHED(7) :: else fi }
  /* grant */
  :: atomic { may_answer(d) && known[c] == its_epoch[d] && !grace[d] && holder[d] == NOBODY ->
       holder[d] = c; has[c] = true; window[c] = 1;
       if :: its_epoch[d] > 1 && mode[1 - d] == SERVES -> REACHED(9) :: else fi }
  /* keep-alive */
  :: atomic { may_answer(d) && known[c] == its_epoch[d] && holder[d] == c && has[c] && window[c] == 2 -> window[c] = 1 }
  /* the end of a client's lease; a release.  Not while the database works on its commit. */
  :: atomic { holder[d] == c && !believes(c) && kind[d] != BATCH && kind[d] != BELIEF && !unsure[d] -> holder[d] = NOBODY }
  od
}

proctype Clocks() {
  byte d;
  end: do
  :: atomic { measures(0) || measures(1) || ages(0) || ages(1) ->
       for (d : 0 .. DAEMONS - 1) {
         if :: measures(d) -> since[d]++ :: else fi;
         if :: ages(d) -> age[d]++ :: else fi
       }
       d = 0 }
  :: atomic { window[0] -> window[0] = 0; has[0] = false }
  :: atomic { window[1] -> window[1] = 0; has[1] = false }
  :: atomic { has[0] -> has[0] = false }
  :: atomic { has[1] -> has[1] = false }
  :: atomic { grace[0] && window[0] != 2 && window[1] != 2 -> grace[0] = false; REACHED(8) }
  :: atomic { grace[1] && window[0] != 2 && window[1] != 2 -> grace[1] = false; REACHED(8) }
  od
}

proctype Primary(byte d) {
  end: do
  :: atomic { stage[d] == SENT && !elsewhere[d] ->
       k = kind[d]; e = its_epoch[d]; n = (kind[d] == BATCH -> number[d] + 1 : number[d]);
       execute();
       if
       :: executed ->
          stage[d] = EXECUTED;
          if :: kind[d] == TAKE -> its_epoch[d] = epoch; number[d] = batch :: else fi
       :: else -> stage[d] = REFUSED
       fi;
       forget() }
  /* faults of one daemon's: cancelled, broken, ended in good order, killed */
  :: atomic { fault && stage[d] == EXECUTED && !elsewhere[d] -> FAULT; stage[d] = WARNED }
  :: atomic { fault && mode[d] != LOOKS && !elsewhere[d] ->
       FAULT;
       if
       :: LATE && stage[d] == SENT && !late_kind ->
          late_kind = kind[d]; late_epoch = its_epoch[d];
          late_number = (kind[d] == BATCH -> number[d] + 1 : number[d])
       :: true
       fi;
       lose(d) }
  :: atomic { fault && serves(d) && idle(d) && epoch == its_epoch[d] && !given_back ->
       FAULT; given_back = true; beat++;
#ifndef GIVES_BACK_EARLY        /* a daemon answers on after it has given its shard back */
       looks(d)
#endif
     }
  :: atomic { fault && mode[d] != LOOKS -> FAULT; looks(d) }
  od
}

proctype Copy() {
  end: do
  :: atomic { kept_epoch != epoch || kept_beat != beat ||
              (stage[0] == EXECUTED && !elsewhere[0]) || (stage[1] == EXECUTED && !elsewhere[1]) ->
       kept_epoch = epoch; kept_batch = batch; kept_beat = beat; kept_given_back = given_back;
       if :: stage[0] == EXECUTED && !elsewhere[0] -> stage[0] = CONFIRMED :: else fi;
       if :: stage[1] == EXECUTED && !elsewhere[1] -> stage[1] = CONFIRMED :: else fi }
  :: atomic { late_kind ->
       k = late_kind; e = late_epoch; n = late_number;
       execute();
       forget(); late_kind = 0; late_epoch = 0; late_number = 0 }
  :: atomic { late_kind -> late_kind = 0; late_epoch = 0; late_number = 0 }
  /* a failover */
  :: atomic { fault && (kept_epoch != epoch || kept_beat != beat) ->
       FAULT;
       if :: kept_batch < shown -> BROKEN(4) :: else fi;
       if :: kept_batch < batch -> REACHED(3) :: else fi;
       epoch = kept_epoch; batch = kept_batch; beat = kept_beat; given_back = kept_given_back;
       late_kind = 0; late_epoch = 0; late_number = 0;
       elsewhere[0] = true; elsewhere[1] = true }
  :: atomic { elsewhere[0] -> lose(0) }
  :: atomic { elsewhere[1] -> lose(1) }
  od
}

proctype Judge() {
  end: do
  :: atomic { believes(0) && believes(1) -> BROKEN(7) }
  :: atomic { (grace[0] && holder[0] != NOBODY) || (grace[1] && holder[1] != NOBODY) -> BROKEN(11) }
#ifdef FAULTS
  :: atomic { timeout && !(renews(0) && idle(0)) && !(renews(1) && idle(1)) -> BROKEN(12) }
#endif
  od
}

init {
  byte c;
  atomic {
    mode[0] = SERVES; its_epoch[0] = 1; holder[0] = NOBODY; holder[1] = NOBODY;
    known[0] = 1; known[1] = 1;
    for (c : 0 .. 1) {
      run Daemon(c); run Answers(c); run Primary(c);
      if :: CLIENTS -> run Client(c, 0); run Client(c, 1) :: else fi
    }
    run Clocks(); run Copy(); run Judge();
    c = 0
  }
}
