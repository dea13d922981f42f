"""oracle.py PRESET NUM K C policies...: plays policies in the MDP."""
import sys,dataclasses,time,functools
import jax,jax.numpy as jnp,numpy as np
import jaxsense as js
from jaxsense import load_pretrained, make_mdp
from jaxsense.dqn import mdp as mdps, starts, policies as P
from jaxsense.dqn.policies import Known
from jaxsense.dqn.team import Team
preset,num,K,C=sys.argv[1],int(sys.argv[2]),int(sys.argv[3]),float(sys.argv[4])
pols=sys.argv[5:]
ROLL=None
config,models=load_pretrained(preset) if '/' not in preset else js.load(preset)
N=config.arena.num_pois
team=dataclasses.replace(config.team,num_pois=(N,N),sides=(config.arena.side,config.arena.side))
config=dataclasses.replace(config,team=team)
bank=js.bank(jax.random.key(5),config,models,512)
mdp=make_mdp(config,models,bank)
R=config.modality_of_robot
teams=dataclasses.replace(mdp.teams,is_random=False,alone=0.,partly_seen=0.)
mdp=dataclasses.replace(mdp,teams=teams,robots=jnp.array(R))
M=mdp.num_modalities
bayes=js.make_bayes(config)
labels=None
def known(state,looks,lp,md):
    return Known(state.belief,looks,lp,state.team,md.times(state),state.agent)
def act(pol,key,state,md):
    looks=jax.lax.stop_gradient(state.seen.astype(jnp.int32))
    k=known(state,looks,jnp.zeros((N,mdp.num_classes)),md)
    v=P.POLICIES[pol](key,models,k)
    return P.best(jnp.where(state.team.action_mask,v,-jnp.inf))
def play(key,state,md,pol,follow=None,first=None,maxs=300):
    """returns total reward, seconds, looks, end state"""
    def go(c):
        st,tot,n,i,done=c
        return ~done&(i<maxs)
    def adv(c):
        st,tot,n,i,done=c
        a=act(pol,jax.random.fold_in(key,2*i),st,md) if follow is None else follow(jax.random.fold_in(key,2*i),st)
        if first is not None: a=jnp.where(i==0,first,a)
        st2,o=mdps.step(jax.random.fold_in(key,2*i+1),md,st,a)
        return st2,tot+o.reward,n+(o.poi<N),i+1,o.terminated
    st,tot,n,i,_=jax.lax.while_loop(go,adv,(state,jnp.float32(0),jnp.int32(0),jnp.int32(0),jnp.bool_(False)))
    return tot,st.seconds-state.seconds,n,st
def rollouts(base,key,state):
    """Best action by K simulated continuations of base."""
    probs=jax.vmap(models.fusion.class_probabilities)(state.belief)
    def one(key,a):
        ck,pk=jax.random.split(key)
        cl=jax.vmap(jax.random.categorical)(jax.random.split(ck,N),jnp.log(jnp.maximum(probs,1e-9))).astype(jnp.int32)
        st=dataclasses.replace(state,classes=cl,scene=cl)
        tot,sec,n,_=play(pk,st,mdp,base,first=a,maxs=60)
        return tot-C*sec
    keys=jax.random.split(key,K)
    vals=jax.vmap(lambda a: jnp.mean(jax.vmap(lambda k: one(k,a))(keys)))(jnp.arange(N+1))
    return jnp.argmax(jnp.where(state.team.action_mask,vals,-jnp.inf)).astype(jnp.int32)
@functools.partial(jax.jit,static_argnums=(1,2))
def run(keys,pol,anew):
    md=dataclasses.replace(mdp,teams=dataclasses.replace(mdp.teams,chooses_anew=anew))
    def ep(key):
        sk,pk=jax.random.split(key)
        st=starts.reset(sk,md)
        follow=None
        if pol.startswith("roll_"): follow=functools.partial(rollouts,pol[5:])
        tot,sec,n,end=play(pk,st,md,pol,follow)
        pr=jax.vmap(models.fusion.class_probabilities)(end.belief)
        right=jnp.mean(jnp.argmax(pr,-1)==end.classes)
        return sec,n/N,right,tot
    return jax.lax.map(ep,keys,batch_size=min(num,256))
keys=jax.random.split(jax.random.key(11),num)
ref=None
for anew in (False,True):
  for pol in pols:
    if pol.startswith("roll_") and not anew: continue
    t=time.time(); sec,n,right,tot=map(np.asarray,run(keys,pol,anew))
    if ref is None or pol==pols[0]: ref=sec
    d=sec-ref
    print(preset,"anew",anew,pol,"mean %.2f s (%+.2f +- %.2f) looks %.2f right %.4f total %.3f  (%.0f s)"%(sec.mean(),d.mean(),1.96*d.std()/len(d)**.5,n.mean(),right.mean(),tot.mean(),time.time()-t),flush=True)
