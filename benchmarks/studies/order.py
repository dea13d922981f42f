"""order.py PRESET STATES ITERS STEPS MAXS TRIES EPISODES W HIDDEN MARGIN: order learned from trials."""

import sys, dataclasses, time, functools, pickle, os
import jax, jax.numpy as jnp, numpy as np, optax
import jaxsense as js
from jaxsense import load_pretrained, make_mdp
from jaxsense.core import networks
from jaxsense.dqn import mdp as mdps, starts, policies as P
from jaxsense.dqn.pooling import PoolingNetwork
from jaxsense.dqn.team import num_features
from jaxsense.dqn.policies import Known

preset = sys.argv[1]
S, iters, steps, MAXS, TRIES, EPIS = map(int, sys.argv[2:8])
W = float(sys.argv[8])
HID = tuple(map(int, sys.argv[9].split(",")))
MARGIN = float(sys.argv[10])
config, models = load_pretrained(preset)
bank = js.bank(jax.random.key(5), config, models, 2048)
train = make_mdp(config, models, bank)
train = dataclasses.replace(train, teams=dataclasses.replace(train.teams, alone=0.0))
agent = models.agent
qp = models.q_networks[0]
M = train.num_modalities
L = agent.latent_size
F = num_features(L, M)
net = PoolingNetwork(HID, F)


def test_mdp(N, R, side):
    team = dataclasses.replace(config.team, num_pois=(N, N), sides=(side, side))
    t = make_mdp(dataclasses.replace(config, team=team), models, bank)
    return dataclasses.replace(
        t,
        teams=dataclasses.replace(t.teams, is_random=False, alone=0.0, partly_seen=0.0),
        robots=jnp.array(R),
    )


def score(order, obs, mask):
    """values: open looks by seconds."""
    q = agent.q(qp, obs)[:-1]
    open_ = (q > MARGIN) & mask[:-1]
    own = 10.0 * obs.reshape(F, -1)[2 * L]
    if order is None:
        v = jnp.where(open_, agent.values(qp, obs)[:-1], -1.0)
        return jnp.append(v, 0.0), open_, own
    s = own + 10.0 * networks.apply(net, order, obs)[:-1]
    return jnp.append(jnp.where(open_, 1e4 - s, -1.0), 0.0), open_, own


def choose(order, mdp, st):
    obs = agent.observe(st.belief, st.team, mdp.times(st), st.agent)
    v, o, t = score(order, obs, st.team.action_mask)
    return v, o, t, obs


def play(key, mdp, order, state, first=None, maxs=MAXS, policy=None):
    def go(c):
        return ~c[3] & (c[2] < maxs)

    def adv(c):
        st, tot, i, done, ends, n = c
        if policy is None:
            a = jnp.argmax(choose(order, mdp, st)[0]).astype(jnp.int32)
        else:
            k = Known(
                st.belief,
                st.seen.astype(jnp.int32),
                jnp.zeros((mdp.num_pois, mdp.num_classes)),
                st.team,
                mdp.times(st),
                st.agent,
            )
            a = P.best(jnp.where(st.team.action_mask, P.POLICIES[policy](key, models, k), -jnp.inf))
        if first is not None:
            a = jnp.where(i == 0, first, a)
        st2, o = mdps.step(jax.random.fold_in(key, i), mdp, st, a)
        return (
            st2,
            tot + o.reward,
            i + 1,
            o.terminated,
            jnp.where(st2.team.works, st2.seconds, ends),
            n + (o.poi < mdp.num_pois),
        )

    ends = jnp.full(state.team.works.shape, state.seconds)
    st, tot, i, done, ends, n = jax.lax.while_loop(
        go,
        adv,
        (state, jnp.float32(0), jnp.int32(0), ~jnp.any(state.team.works), ends, jnp.int32(0)),
    )
    ends = jnp.where(st.team.works, st.seconds, ends)
    last = st.seconds - state.seconds
    mean = jnp.sum(jnp.where(state.team.works, ends - state.seconds, 0)) / jnp.maximum(
        jnp.sum(state.team.works), 1
    )
    return tot, W * last + (1 - W) * mean, st, n


def trial(key, order):
    sk, nk, wk, tk, pk = jax.random.split(key, 5)
    st = starts.reset(sk, train)
    number = jax.random.randint(nk, (), 0, MAXS // 2)

    def walk(i, st):
        a_k, s_k, e_k = jax.random.split(jax.random.fold_in(wk, i), 3)
        v, o, t, _ = choose(order, train, st)
        rnd = jnp.argmax(
            jnp.append(jnp.where(o, jax.random.gumbel(a_k, o.shape) - t / 5.0, -1e3), -1e2)
        )
        a = jnp.where(jax.random.uniform(e_k) < 0.15, rnd, jnp.argmax(v)).astype(jnp.int32)
        new, oc = mdps.step(s_k, train, st, a)
        stop = oc.terminated | (i >= number)
        return jax.tree.map(lambda x, y: jnp.where(stop, x, y), st, new)

    st = jax.lax.fori_loop(0, MAXS // 2, walk, st)
    v, o, t, obs = choose(order, train, st)
    rank = jnp.where(o, jax.random.gumbel(tk, o.shape) - t / 5.0, -jnp.inf)
    rank = rank.at[jnp.argmax(v[:-1])].add(jnp.where(jnp.any(o), 1e3, 0.0))
    _, tried = jax.lax.top_k(rank, min(TRIES, o.shape[0]))
    ok = o[tried] & (jnp.sum(o) > 1)
    _, sec, _, _ = jax.vmap(lambda a: play(pk, train, order, st, first=a.astype(jnp.int32)))(tried)
    return obs, tried, ok, sec


@jax.jit
def trials(keys, order):
    return jax.lax.map(lambda k: trial(k, order), keys, batch_size=min(S, 16384))


def fit(key, order, data, steps, lr=2e-3, batch=1024):
    obs, tried, ok, G = data
    some = np.flatnonzero(np.asarray(ok).any(1))
    some = jnp.asarray(some)
    opt = optax.adam(optax.cosine_decay_schedule(lr, steps, 0.0))

    def loss(p, idx, data):
        obs, tried, ok, G = data
        x = obs[idx].T
        s = x.reshape(F, -1, x.shape[1])[2 * L] * 10.0 + 10.0 * networks.apply(net, p, x)[:-1]
        sa = jnp.take_along_axis(s, tried[idx].T, axis=0)
        o = ok[idx].T
        g = G[idx].T
        cnt = jnp.maximum(o.sum(0), 1)
        c = lambda x: x - (jnp.where(o, x, 0).sum(0) / cnt)[None]
        e = jnp.where(o, c(jnp.where(o, g, 0.0)) - c(jnp.where(o, sa, 0.0)), 0.0) / 3.0
        return jnp.sum(jnp.sqrt(1 + e**2) - 1) / jnp.maximum(jnp.sum(o), 1)

    @jax.jit
    def run(p, key, data):
        idx = some[jax.random.randint(key, (steps, batch), 0, len(some))]

        def step(c, idx):
            p, s = c
            l, g = jax.value_and_grad(loss)(p, idx, data)
            u, s = opt.update(g, s, p)
            return (optax.apply_updates(p, u), s), l

        (p, _), l = jax.lax.scan(step, (p, opt.init(p)), idx)
        return p, l

    p, l = run(order, key, data)
    return p, np.asarray(l), len(some)


def evaluator(N, R, side):
    mdp = test_mdp(N, R, side)

    @functools.partial(jax.jit, static_argnums=2)
    def ev(keys, order, policy=None):
        def ep(key):
            sk, pk = jax.random.split(key)
            st = starts.reset(sk, mdp)
            tot, _, end, n = play(pk, mdp, order, st, maxs=400, policy=policy)
            pr = jax.vmap(models.fusion.class_probabilities)(end.belief)
            return end.seconds, tot, jnp.mean(jnp.argmax(pr, -1) == end.classes), n / N

        return jax.lax.map(ep, keys, batch_size=512)

    return ev


N = config.arena.num_pois
cases = {"own": (N, config.modality_of_robot, config.arena.side)}
if preset == "team":
    cases.update({"3": (3, (0, 1), 3.0), "16": (16, (0, 1), 6.0), "16x4": (16, (0, 0, 1, 1), 6.0)})
ek = jax.random.split(jax.random.key(11), 1024)
evs = {n: evaluator(*c) for n, c in cases.items()}
refs = {}


def show(name, order, policy=None):
    for n, ev in evs.items():
        s, tot, r, k = map(np.asarray, ev(ek, order, policy))
        refs.setdefault(n, s)
        d = s - refs[n]
        print(
            preset,
            sys.argv[8:],
            n,
            name,
            "%.2f s (%+.2f +- %.2f; %.3f) total %.3f right %.4f looks %.2f"
            % (
                s.mean(),
                d.mean(),
                1.96 * d.std() / len(d) ** 0.5,
                s.mean() / refs[n].mean(),
                tot.mean(),
                r.mean(),
                k.mean(),
            ),
            flush=True,
        )


show("auction", None, "auction")
show("latent", None)
order = None
new = networks.init(jax.random.key(3), net, F * train.num_pois)
for it in range(iters):
    t = time.time()
    data = jax.block_until_ready(
        trials(jax.random.split(jax.random.fold_in(jax.random.key(2), it), S), order)
    )
    t1 = time.time()
    new, l, some = fit(jax.random.fold_in(jax.random.key(9), it), new, data, steps)
    t2 = time.time()
    order = new
    show(
        f"iter {it} trials {t1 - t:.0f} s of {some} fit {t2 - t1:.0f} s loss {l[:20].mean():.4f} {l[-50:].mean():.4f}",
        order,
    )
if EPIS:

    def pol(key, m, known):
        obs = agent.observe(known.belief, known.team, known.times, known.robot)
        return score(order, obs, known.team.action_mask)[0]

    t = time.time()
    sc = js.score_missions(
        config, models, {"order": pol}, against=("auction", "latent"), episodes=EPIS, seed=7
    )
    print(preset, sys.argv[8:], sc, "%.0f s" % (time.time() - t), flush=True)
