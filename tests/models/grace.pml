/* A restarted shard, its grace, and who may still believe in a grant of an earlier epoch.
 *
 * Each step names what it mirrors in enact_dist/core (file:function):
 *   shard/on_session.py:on_hello, _durable, state/sessions.py:hello   hello, durable before it is welcome
 *   shard/on_session.py:on_goodbye, end, shard/shard.py:_on_tick (idle)   the end of a session
 *   shard/on_session.py:on_keep_alive, client/session.py:_alive   keep-alive
 *   state/sessions.py:__init__, in_grace, end_grace_if_all_acknowledged   the grace and its two ends
 *   state/grants.py:grant_ready, shard/state.py:grant_ready   grant
 *   shard/shard.py:_expire, state/sessions.py:lease_end_ns   lease
 *   client/session.py:hello, _welcomed, _epoch_changed, _drop_grants   what a client knows
 *   client/lock.py:_on_acquiring, valid, client/lease_clock.py   belief
 *
 * Network: requests and Welcomes stay deliverable for ever; a grant can be taken until its belief
 * would be over (belief counts from the sending of the request, see client/lease_clock.py).
 * Time: `window` of a client is open while anything that it was granted may still be believed in.
 * It closes at any moment.  The clocks' bounded drift (2 %) gives one rule: a shard's lease, and
 * the full length of a grace, end only after the windows that they stand for have closed.
 */
#ifndef EPOCHS
#define EPOCHS 2
#endif
#define CLIENTS 2
#define NOBODY 9

/* A client. */
byte known[CLIENTS];            /* epoch of the shard; 0: none */
bool acknowledged[CLIENTS];     /* a Hello has confirmed that epoch */
bool waits[CLIENTS];
bool has[CLIENTS];              /* a grant, in its own eyes */
bool window[CLIENTS];
bool gone[CLIENTS];             /* said goodbye */

/* Messages under way.  Some need no variable: a Hello of every epoch that a client knows or knew,
 * an Acquire of the epoch that it knows, and the Goodbye of one that is gone may always come (again). */
byte welcomes_open[CLIENTS];    /* Welcomes, one bit for each epoch that the client does not know yet */
byte welcomes_grace[CLIENTS];
bool confirmed[CLIENTS];        /* the Welcome to a Hello that knew the epoch that the client knows */
byte grants[CLIENTS];           /* the newest grant's epoch; 0: none that could be believed in */

/* The shard. */
byte epoch = 1;
bool grace;
byte holder = NOBODY;
bool session[CLIENTS];
bool recording[CLIENTS];        /* its record is at the store */
bool durable[CLIENTS];          /* the record is there; may outlast the session for a while */
bool present[CLIENTS];          /* it said hello in this epoch */
bool agreed[CLIENTS];           /* it has acknowledged this epoch */

byte rule;
#define BROKEN(n) rule = n; assert(rule != n)
#ifdef GOAL
#define REACHED(n) if :: n == GOAL -> BROKEN(100 + n) :: else fi
#else
#define REACHED(n) skip
#endif
#define believes(c) (has[c] && window[c])
#define awaited(c) (session[c] && durable[c] && !recording[c] && !agreed[c])

#ifdef WELCOMES_EARLY           /* a session may act before its record is durable */
#define may_act(c) (present[c] || recording[c])
#else
#define may_act(c) present[c]
#endif
#ifdef OLD_GRANT                /* a client takes a grant of an epoch that is over */
#define current(c) true
#else
#define current(c) (grants[c] == known[c])
#endif
#ifdef SHORT_GRACE              /* the grace by time is shorter than a belief */
#define time_is_over true
#else
#define time_is_over (!window[0] && !window[1])
#endif

inline end_grace_if_all_acknowledged() {
  if
  :: grace && !awaited(0) && !awaited(1) -> grace = false; REACHED(1)
  :: else
  fi
}

inline welcome(c) {
  if
  :: known[c] < epoch && grace -> welcomes_grace[c] = welcomes_grace[c] | (1 << epoch)
  :: known[c] < epoch && !grace -> welcomes_open[c] = welcomes_open[c] | (1 << epoch)
  :: else
  fi
}

inline learn(c, e) {
  known[c] = e;
  confirmed[c] = false;
  welcomes_open[c] = (welcomes_open[c] >> (e + 1)) << (e + 1);
  welcomes_grace[c] = (welcomes_grace[c] >> (e + 1)) << (e + 1);
#ifndef KEEPS_GRANTS            /* a client acknowledges without dropping what it holds */
  has[c] = false;
#endif
  acknowledged[c] = false
}

/* Welcome of one epoch, maybe an old one. */
proctype Welcomes(byte c; byte e) {
  end: do
  :: atomic { !gone[c] && e > known[c] && (welcomes_open[c] & (1 << e)) ->
       if
       :: known[c] == 0 -> learn(c, e); acknowledged[c] = true
       :: else -> learn(c, e)
       fi }
  :: atomic { !gone[c] && e > known[c] && (welcomes_grace[c] & (1 << e)) -> learn(c, e) }
  od
}

proctype Client(byte c) {
  end: do
  :: atomic { !gone[c] && confirmed[c] && !acknowledged[c] -> acknowledged[c] = true }
  /* EpochChanged: a new epoch, or one in which the session is not known (any more) */
  :: atomic { !gone[c] && known[c] && known[c] < epoch -> learn(c, epoch) }
  :: atomic { !gone[c] && known[c] == epoch && !present[c] && acknowledged[c] -> learn(c, epoch) }
  /* acquire */
  :: atomic { !gone[c] && acknowledged[c] && !has[c] && !waits[c] -> waits[c] = true }
  :: atomic { waits[c] && grants[c] && window[c] && current(c) ->
       has[c] = true;
       waits[c] = false;
       if :: known[c] == EPOCHS -> REACHED(2) :: else fi }
  :: atomic { waits[c] && grants[c] && window[c] && !current(c) -> waits[c] = false; REACHED(3) }   /* refused, given up */
  /* release, or give up waiting */
  :: atomic { has[c] -> has[c] = false }
  :: atomic { waits[c] -> waits[c] = false }
  /* its own clock */
  :: atomic { window[c] -> window[c] = false; grants[c] = 0 }
  :: atomic { !gone[c] -> gone[c] = true; has[c] = false; waits[c] = false }
  od
}

/* Hello of a session that knows one epoch (0: none), maybe an old one. */
proctype Hellos(byte c; byte e) {
  end: do
  :: atomic { e <= known[c] && !recording[c] ->
       if
       :: !session[c] ->
          session[c] = true; agreed[c] = true; recording[c] = true
       :: else ->
#ifdef BLIND_ACKNOWLEDGEMENT    /* any hello counts as one of this epoch */
          agreed[c] = true;
#else
          if :: e == epoch -> agreed[c] = true :: else fi;
#endif
          present[c] = true;
          end_grace_if_all_acknowledged();
          welcome(c);
          if :: e == epoch -> confirmed[c] = true :: else fi
       fi }
  od
}

proctype Shard(byte c) {
  end: do
  :: atomic { recording[c] ->
       recording[c] = false; durable[c] = true; present[c] = true;
       welcome(c) }
#ifdef WELCOMES_EARLY
  :: atomic { recording[c] && !(welcomes_open[c] & (1 << epoch)) && !grace -> welcome(c) }
#endif
  /* goodbye, or idle for long; its record goes when the store comes to it */
  :: atomic { session[c] && !recording[c] && (gone[c] || (!window[c] && !grace)) ->
       if :: grace && awaited(c) -> REACHED(4) :: else fi;
       session[c] = false; present[c] = false; agreed[c] = false;
       if :: holder == c -> holder = NOBODY; grants[c] = 0 :: else fi;
       end_grace_if_all_acknowledged() }
  :: atomic { durable[c] && !session[c] -> durable[c] = false }
  /* acquire, and grant */
  :: atomic { known[c] == epoch && may_act(c) && !grace && holder == NOBODY ->
       holder = c; window[c] = true; grants[c] = epoch }
  /* keep-alive: the lease and the belief go on */
  :: atomic { holder == c && present[c] && known[c] == epoch && !window[c] -> window[c] = true; if :: has[c] -> REACHED(5) :: else fi }
  /* the end of a lease; a release, which does not touch what is waited for */
  :: atomic { holder == c && !window[c] -> holder = NOBODY; grants[c] = 0 }
  :: atomic { holder == c && !has[c] && !waits[c] -> holder = NOBODY; grants[c] = 0 }
  od
}

proctype Restarts() {
  end: do
  :: atomic { epoch < EPOCHS ->
       epoch++;
       holder = NOBODY;
       session[0] = durable[0]; session[1] = durable[1];
       recording[0] = false; recording[1] = false;
       present[0] = false; present[1] = false;
       agreed[0] = false; agreed[1] = false;
#ifdef NO_GRACE                 /* a restarted shard grants at once */
       grace = false
#else
       grace = session[0] || session[1]
#endif
     }
  :: atomic { grace && time_is_over -> grace = false; REACHED(6) }
  od
}

proctype Judge() {
  end: do
  :: atomic { believes(0) && believes(1) -> BROKEN(7) }
  :: atomic { holder != NOBODY && grace -> BROKEN(11) }
  od
}

init {
  byte c;
  byte e;
  atomic {
    for (c : 0 .. CLIENTS - 1) {
      run Client(c); run Shard(c);
      run Hellos(c, 0);
      for (e : 1 .. EPOCHS) { run Hellos(c, e); run Welcomes(c, e) }
    }
    run Restarts(); run Judge();
    c = 0; e = 0
  }
}
