"""imp2.py PRESET STATES ITERS STEPS MAXS TRIES EPISODES C:W:base|scratch ..."""
import sys,dataclasses,time,functools,pickle,os
import jax,jax.numpy as jnp,numpy as np,optax
import jaxsense as js
from jaxsense import load_pretrained, make_mdp
from jaxsense.dqn import mdp as mdps, starts, policies as P
from jaxsense.dqn.policies import Known
preset=sys.argv[1]; S,iters,steps,MAXS,TRIES,EPIS=map(int,sys.argv[2:8]); variants=sys.argv[8:]
OUT=os.environ.get("OUT","/tmp")
config,models=load_pretrained(preset)
if os.environ.get("HIDDEN"):
    h=tuple(map(int,os.environ["HIDDEN"].split(",")))
else: h=None
bank=js.bank(jax.random.key(5),config,models,2048)
train=make_mdp(config,models,bank)
train=dataclasses.replace(train,teams=dataclasses.replace(train.teams,alone=0.0))
N=config.arena.num_pois
team=dataclasses.replace(config.team,num_pois=(N,N),sides=(config.arena.side,config.arena.side))
test=make_mdp(dataclasses.replace(config,team=team),models,bank)
test=dataclasses.replace(test,teams=dataclasses.replace(test.teams,is_random=False,alone=0.,partly_seen=0.),robots=jnp.array(config.modality_of_robot))
agent0=models.agent
params0=models.q_networks[0]
HUB=.5
def values(agent,params,mdp,state):
    obs=agent.observe(state.belief,state.team,mdp.times(state),state.agent)
    return jnp.where(state.team.action_mask,agent.values(params,obs),-jnp.inf),obs
def play(key,mdp,agent,params,state,W=1.0,first=None,maxs=MAXS,policy=None):
    def go(c): return ~c[3]&(c[2]<maxs)
    def adv(c):
        st,tot,i,done,ends,n=c
        if policy is None: a=jnp.argmax(values(agent,params,mdp,st)[0]).astype(jnp.int32)
        else:
            k=Known(st.belief,st.seen.astype(jnp.int32),jnp.zeros((N,mdp.num_classes)),st.team,mdp.times(st),st.agent)
            a=P.best(jnp.where(st.team.action_mask,P.POLICIES[policy](key,models,k),-jnp.inf))
        if first is not None: a=jnp.where(i==0,first,a)
        st2,o=mdps.step(jax.random.fold_in(key,i),mdp,st,a)
        return st2,tot+o.reward,i+1,o.terminated,jnp.where(st2.team.works,st2.seconds,ends),n+(o.poi<mdp.num_pois)
    ends=jnp.full(state.team.works.shape,state.seconds)
    st,tot,i,done,ends,n=jax.lax.while_loop(go,adv,(state,jnp.float32(0),jnp.int32(0),~jnp.any(state.team.works),ends,jnp.int32(0)))
    last=st.seconds-state.seconds
    mean=jnp.sum(jnp.where(state.team.works,ends-state.seconds,0))/jnp.maximum(jnp.sum(state.team.works),1)
    return tot,W*last+(1-W)*mean,st,n
def trial(key,agent,params,C,W):
    sk,nk,wk,tk,pk,ek=jax.random.split(key,6)
    st=starts.reset(sk,train)
    number=jax.random.randint(nk,(),0,MAXS//2)
    def walk(i,st):
        k=jax.random.fold_in(wk,i); a_k,s_k,e_k=jax.random.split(k,3)
        v,_=values(agent,params,train,st)
        rnd=jax.random.categorical(a_k,jnp.where(st.team.action_mask,0.,-jnp.inf).at[-1].set(-2.))
        a=jnp.where(jax.random.uniform(e_k)<.1,rnd,jnp.argmax(v)).astype(jnp.int32)
        new,o=mdps.step(s_k,train,st,a)
        stop=o.terminated|(i>=number)
        return jax.tree.map(lambda x,y: jnp.where(stop,x,y),st,new)
    st=jax.lax.fori_loop(0,MAXS//2,walk,st)
    v,obs=values(agent,params,train,st)
    rank=jnp.where(jnp.isfinite(v),jax.random.gumbel(tk,v.shape),-jnp.inf).at[jnp.argmax(v)].add(1e3)
    rank=rank+jnp.append(-train.times(st)[st.agent]/5.0,0.0)
    _,tried=jax.lax.top_k(rank,min(TRIES,v.shape[0]))
    ok=jnp.isfinite(v)[tried]
    tot,sec,_,_=jax.vmap(lambda a: play(pk,train,agent,params,st,W,first=a.astype(jnp.int32)))(tried)
    return obs,tried,ok,tot-C*sec
@jax.jit
def trials(keys,agent,params,C,W): return jax.lax.map(lambda k: trial(k,agent,params,C,W),keys,batch_size=min(S,16384))
def fit(key,agent,params,data,steps,lr=1e-3,batch=2048):
    obs,tried,ok,G=data; n=len(obs)
    opt=optax.adam(optax.cosine_decay_schedule(lr,steps,.01))
    def loss(p,idx,data):
        obs,tried,ok,G=data
        q=agent.values(p,obs[idx].T); q=jnp.where(q>-1e5,q,0.)
        qa=jnp.take_along_axis(q,tried[idx].T,axis=0); o=ok[idx].T; g=G[idx].T
        cnt=jnp.maximum(o.sum(0),1); c=lambda x: x-(jnp.where(o,x,0).sum(0)/cnt)[None]
        e=jnp.where(o,c(g)-c(qa),0.)
        return jnp.sum(jnp.sqrt(1+(e/HUB)**2)-1)/jnp.sum(o)
    @jax.jit
    def run(p,key,data):
        idx=jax.random.randint(key,(steps,batch),0,n)
        def step(c,idx):
            p,s=c; l,g=jax.value_and_grad(loss)(p,idx,data); u,s=opt.update(g,s,p); return (optax.apply_updates(p,u),s),l
        (p,_),l=jax.lax.scan(step,(p,opt.init(p)),idx); return p,l
    p,l=run(params,key,data); return p,np.asarray(l)
@functools.partial(jax.jit,static_argnums=3)
def evaluate(keys,agent,params,policy=None):
    def ep(key):
        sk,pk=jax.random.split(key); st=starts.reset(sk,test)
        tot,_,end,n=play(pk,test,agent,params,st,maxs=300,policy=policy)
        pr=jax.vmap(models.fusion.class_probabilities)(end.belief)
        return end.seconds,tot,jnp.mean(jnp.argmax(pr,-1)==end.classes),n/N
    return jax.lax.map(ep,keys,batch_size=512)
ek=jax.random.split(jax.random.key(11),1024)
ref=None
def show(name,found):
    global ref
    s,tot,r,n=map(np.asarray,found)
    if ref is None: ref=s
    d=s-ref
    print(preset,name,"%.2f s (%+.2f +- %.2f; %.3f) total %.3f right %.4f looks %.2f"%(s.mean(),d.mean(),1.96*d.std()/len(d)**.5,s.mean()/ref.mean(),tot.mean(),r.mean(),n.mean()),flush=True)
show("auction",evaluate(ek,agent0,params0,"auction"))
show("latent",evaluate(ek,agent0,params0))
own={}
for v in variants:
    C,W,how=v.split(":"); C,W=float(C),float(W)
    agent1=dataclasses.replace(agent0,discount=1.0,second_cost=C)
    if h: agent1=dataclasses.replace(agent1,hidden=h)
    agent,params=agent0,params0
    new=params0 if how=="base" and not h else agent1.init(jax.random.key(3))
    for it in range(iters):
        t=time.time(); data=jax.block_until_ready(trials(jax.random.split(jax.random.fold_in(jax.random.key(2),it),S),agent,params,C,W)); t1=time.time()
        new,l=fit(jax.random.fold_in(jax.random.key(9),it),agent1,new,data,steps); t2=time.time()
        agent,params=agent1,new
        show(f"{v} iter {it} trials {t1-t:.0f} s fit {t2-t1:.0f} s loss {l[:50].mean():.4f} {l[-50:].mean():.4f}",evaluate(ek,agent,params))
        pickle.dump((C,agent1.hidden,jax.tree.map(np.asarray,params)),open(f"{OUT}/{preset}-{C}-{W}-{how}-{it}.pkl","wb"))
        def pol(key,m,known,agent=agent1,params=params):
            return agent.values(params,agent.observe(known.belief,known.team,known.times,known.robot))
        if it>=iters-1: own[f"i{it}_{C}_{W}_{how}"]=pol
if EPIS:
    t=time.time()
    sc=js.score_missions(config,models,{**own},against=("auction","latent"),episodes=EPIS,seed=7)
    print(sc,"%.0f s"%(time.time()-t),flush=True)
