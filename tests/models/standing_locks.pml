/* A lock that waits for news: outside the queue, as a parked request and nothing else.
 *
 * Each step names what it mirrors in enact_dist/core (file:function):
 *   shard/on_lock.py:on_acquire, _has_news   compared when the request comes
 *   shard/on_lock.py:begin_standing, _admit   compared again at each change
 *   shard/state.py:park, end_slices, drop   the parked request of a lane, and its end
 *   client/lock.py:_acquire, _on_acquiring, release   asked again under the same seq
 *   state/grants.py:take_away   the lease ends
 *
 * One shard, one actor, one datum that changes FIRES times.  Requests and answers come late, again
 * or never; the lease may end at any moment.  The actor asks with what its last update that ended
 * well has seen.
 */
#ifndef FIRES
#define FIRES 3
#endif
#ifndef LOSSES
#define LOSSES 2
#endif
#define SEQS 6

#define ASKS  1                 /* waits for its grant */
#define IN    2                 /* in its update */
#define ENDS  3                 /* has sent its commit */
#define WAIT  1                 /* answers */
#define GRANT 2
#define STALE 3
#define DONE  1
#define FENCED 2

byte newest;                    /* the datum; 0: null */

/* The shard. */
byte top;                       /* seq of the newest lock that entered the queue */
bool held;                      /* it is granted */
byte shown;                     /* what it shows */
byte parked; byte parked_seen;  /* seq of the request that waits for news, 0: none */
byte outcome;                   /* seq of the newest commit */
byte grants[SEQS + 1];

/* Messages: a request and a late copy of one, the answer to it, the answer to a commit. */
byte request; byte request_seen;
byte copy; byte copy_seen;
byte answer; byte answer_shown;
byte ended;
byte losses; byte slices;

/* The actor. */
byte phase;
byte seq = 1;
byte seen;                      /* what the last update that ended well has seen */
byte looks_at;

byte rule;
#define BROKEN(n) rule = n; assert(rule != n)
#ifdef GOAL
#define REACHED(n) if :: n == GOAL -> BROKEN(100 + n) :: else fi
#else
#define REACHED(n) skip
#endif

inline enter(s) {               /* it enters the queue, where nothing else is: granted */
  top = s; held = true; shown = newest;
  if :: grants[s] -> BROKEN(1) :: else -> grants[s] = 1 fi;
  if :: s == seq && phase == ASKS -> answer = GRANT; answer_shown = shown :: else fi
}

inline take(s, its_seen) {      /* Acquire */
  if
  :: held && s == top ->        /* asked again: the grant again */
     if :: s == seq && phase == ASKS -> answer = GRANT; answer_shown = shown; REACHED(4) :: else fi
#ifndef TAKES_COPY
  :: !(held && s == top) && s <= top ->
     if :: s == seq && phase == ASKS -> answer = STALE :: else -> REACHED(6) fi
#endif
#ifdef TAKES_COPY               /* a late copy enters the queue again */
  :: !(held && s == top) ->
#else
  :: !(held && s == top) && s > top ->
#endif
     if :: held && s > top -> held = false :: else fi;   /* a newer lock of its lane */
#ifdef NO_LOOK                  /* the shard compares at changes only */
     if
     :: parked = s; parked_seen = its_seen
     fi
#else
     if
#ifdef ALWAYS                   /* granted without news */
     :: newest -> enter(s)
     :: !newest -> parked = s; parked_seen = its_seen
#else
     :: newest != its_seen -> enter(s); REACHED(2)
     :: newest == its_seen -> parked = s; parked_seen = its_seen
#endif
     fi
#endif
  fi
}

proctype Shard() {
  byte s; byte its_seen;
  end: do
  :: atomic { request -> s = request; its_seen = request_seen; request = 0; request_seen = 0;
       take(s, its_seen); s = 0; its_seen = 0 }
  :: atomic { copy -> s = copy; its_seen = copy_seen; copy = 0; copy_seen = 0;
       take(s, its_seen); s = 0; its_seen = 0 }
  :: atomic { newest < FIRES ->
       newest++;
#ifndef NO_FIRE                 /* a change looks at what is parked */
       if
       :: parked && newest != parked_seen -> s = parked; parked = 0; parked_seen = 0;
          if :: held && s > top -> held = false :: else fi;
          if :: s > top -> enter(s); REACHED(1) :: else fi; s = 0
       :: else
       fi
#endif
     }
  /* the slice of waiting ends, or the shard restarts with nothing parked */
  :: atomic { parked && slices < LOSSES -> slices++;
       if :: parked == seq && phase == ASKS -> answer = WAIT; REACHED(3) :: else fi;
       parked = 0; parked_seen = 0 }
  :: atomic { phase == ENDS && !ended ->
       if
       :: outcome == seq -> ended = DONE
       :: outcome != seq && held && top == seq -> outcome = seq; held = false; ended = DONE
       :: outcome != seq && !(held && top == seq) -> ended = FENCED; REACHED(5)
       fi }
  /* the lease ends */
  :: atomic { held && losses < LOSSES -> losses++; held = false }
  /* what is on its way gets lost */
  :: atomic { request && losses < LOSSES -> losses++; request = 0; request_seen = 0 }
  :: atomic { answer && losses < LOSSES -> losses++; answer = 0; answer_shown = 0 }
  od
}

inline next() {                 /* its next lock, under a new seq */
  seq++; phase = 0; answer = 0; answer_shown = 0
}

proctype Actor() {
  end: do
  /* it asks for the first time, or again where no answer came */
#ifdef ASKS_ONCE
  :: atomic { phase == 0 && seq < SEQS -> phase = ASKS; request = seq; request_seen = seen }
#else
  :: atomic { phase == 0 && seq < SEQS -> phase = ASKS; request = seq; request_seen = seen }
  :: atomic { phase == ASKS && !request && !answer && parked != seq ->
       if :: !copy -> request = seq; request_seen = seen; copy = seq; copy_seen = seen
          :: request = seq; request_seen = seen fi }
#endif
  :: atomic { phase == ASKS && answer == WAIT -> answer = 0;
#ifndef ASKS_ONCE
       request = seq; request_seen = seen
#endif
     }
  :: atomic { phase == ASKS && answer == STALE -> next() }
  :: atomic { phase == ASKS && answer == GRANT ->
       if :: answer_shown == seen -> BROKEN(2) :: else fi;
       looks_at = answer_shown; answer = 0; answer_shown = 0; phase = IN;
#ifdef FORGETS_NEWS             /* seen at the grant, whatever becomes of the update */
       seen = looks_at
#endif
     }
  :: atomic { phase == IN -> phase = ENDS; ended = 0 }
  :: atomic { phase == ENDS && ended == DONE -> ended = 0; seen = looks_at; looks_at = 0; next() }
  :: atomic { phase == ENDS && ended == FENCED -> ended = 0; looks_at = 0; next() }
  od
}

proctype Judge() {              /* whatever changed is looked at in the end */
  end: do
  :: atomic { timeout && seen < newest && seq < SEQS -> BROKEN(12) }
#ifdef FORGETS_NEWS
  :: atomic { timeout && outcome < seq - 1 && seq < SEQS -> BROKEN(12) }
#endif
  od
}

init { atomic { run Shard(); run Actor(); run Judge() } }
