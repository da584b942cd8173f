"""A simulation of many replicas behind Envoy: who gets which request, what is cached where, how long frames wait.

    defaults.py    what the simulation decided: the values that Envoy's configuration and the chart take
    costs.py       what a frame and the loading of a scene cost, from measured figures
    workload.py    clients, the scenes that they ask for, the times at which they do
    balancers.py   random, least request, ring hash, Maglev, and a bound on the load, as Envoy does them
    caches.py      the scenes that a replica holds
    routing.py     event by event: the replica of every request and stream, replicas that die and join
    queues.py      pose by pose: how long each waits in its replica
    outcome.py     one run in figures, several runs in means with confidence
    study.py       a case, and one run of it; cases.py has all that are run
    theory.py      formulas for cases with known answers; checks.py compares the simulation with them
    tables.py      the figures as Markdown; picture.py draws them

`python benchmarks/simulation.py` runs it; docs/scaling.md says what follows.
"""
