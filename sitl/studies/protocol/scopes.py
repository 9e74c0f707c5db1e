"""What is explored with the rules as they are."""

from __future__ import annotations

from dataclasses import replace

from sitl.studies.protocol.agent import AGENTS, RESTARTS, Scope

_ONCE = Scope(readings=((1,),) * AGENTS)
_TWO_ONCE = replace(_ONCE, world="pair")
_EVERYBODY = frozenset(range(AGENTS))
SCOPES = {
    "two propose once": _TWO_ONCE,
    "two propose twice": replace(_TWO_ONCE, readings=((1, 2), (1, 2), ())),
    "one excluded": replace(_TWO_ONCE, readings=((1, 2), (1, 2), ()), suspects=frozenset({0})),
    "one interrupted": replace(_TWO_ONCE, interruptions=1),
    "two stop": Scope(
        world="turns",
        readings=((1, 2), (1, 2), ()),
        doubts=frozenset({0, 1}),
        leaves=frozenset({0}),
        interruptions=1,
        kinds=frozenset({RESTARTS}),
    ),
    "all propose once": _ONCE,
    "all propose twice": Scope(),
    "two of three meet": Scope(world="crossings"),
    "one follows another": Scope(world="follow"),
    "all excluded": replace(_ONCE, suspects=_EVERYBODY),
    "all interrupted": replace(_ONCE, interruptions=1),
    "everything": Scope(suspects=_EVERYBODY, interruptions=1),
}
