import sys,dataclasses,time,functools
import jax,jax.numpy as jnp,numpy as np
import jaxsense as js
from jaxsense import load_pretrained, make_mdp
from jaxsense.dqn import mdp as mdps, starts, policies as P
from jaxsense.dqn.policies import Known
preset,num=sys.argv[1],int(sys.argv[2]); pols=sys.argv[3:]
config,models=load_pretrained(preset) if '/' not in preset else js.load(preset)
N=config.arena.num_pois
team=dataclasses.replace(config.team,num_pois=(N,N),sides=(config.arena.side,)*2)
config=dataclasses.replace(config,team=team)
bank=js.bank(jax.random.key(5),config,models,512)
mdp=make_mdp(config,models,bank)
R=config.modality_of_robot
teams=dataclasses.replace(mdp.teams,is_random=False,alone=0.,partly_seen=0.)
mdp=dataclasses.replace(mdp,teams=teams,robots=jnp.array(R))
gains=P._on_map
def q_of(models,k):
    a=models.agent; o=a.observe(k.belief,k.team,k.times,k.robot)
    return a.q(models.q_networks[0],o), a.values(models.q_networks[0],o)
def greedy_time(key,models,k):
    g=gains(models,k)[k.robot]; t=k.times[k.robot]
    return jnp.append(jnp.where(g>0,g*0.2**t,-1.),0.)
def masked(key,models,k):
    q,v=q_of(models,k); g=gains(models,k)[k.robot]
    return jnp.append(jnp.where(g>0,jnp.maximum(v[:-1],1e-12*0.2**k.times[k.robot]),-1.),0.)
def useful_nearest(key,models,k):
    q,v=q_of(models,k)
    return P.nearest(jnp.broadcast_to(q[None,:-1],k.times.shape),k.times,k.team,k.robot)
def lat_auction(key,models,k):
    def of(r):
        kk=dataclasses.replace(k,robot=r); return q_of(models,kk)[0][:-1]
    g=jax.vmap(of)(jnp.arange(len(R)))
    return P.auction(g,k.times,k.team,k.robot)
def greedy_team(key,models,k):
    g=gains(models,k)[k.robot]; t=k.times[k.robot]
    free=~k.team.is_taken(k.robot)
    return jnp.append(jnp.where((g>0)&free,1+g*0.2**t,-1.),0.)
def gt(g0):
    def f(key,models,k):
        g=gains(models,k)[k.robot]; t=k.times[k.robot]
        return jnp.append(jnp.where(g>0,jnp.log(jnp.maximum(g,1e-9))+t*np.log(g0)+1e3,-1.),0.)
    return f
OWN=dict(gt5=gt(.5),gt2=gt(.2),gt1=gt(.1),gt05=gt(.05),gt02=gt(.02),gt001=gt(.001),greedy_time=greedy_time,masked=masked,useful_nearest=useful_nearest,lat_auction=lat_auction)
ALL={**P.POLICIES,**OWN}
def known(state,md):
    return Known(state.belief,state.seen.astype(jnp.int32),jnp.zeros((N,mdp.num_classes)),state.team,md.times(state),state.agent)
def act(pol,key,state,md):
    v=ALL[pol](key,models,known(state,md))
    return P.best(jnp.where(state.team.action_mask,v,-jnp.inf))
@functools.partial(jax.jit,static_argnums=(1,))
def run(keys,pol):
    md=mdp
    def ep(key):
        sk,pk=jax.random.split(key)
        st=starts.reset(sk,md)
        def adv(c):
            st,tot,n,i,done,use=c
            a=act(pol,jax.random.fold_in(pk,2*i),st,md)
            st2,o=mdps.step(jax.random.fold_in(pk,2*i+1),md,st,a)
            return st2,tot+o.reward,n+(o.poi<N),i+1,o.terminated,use
        st2,tot,n,_,_,_=jax.lax.while_loop(lambda c:~c[4]&(c[3]<300),adv,(st,jnp.float32(0),jnp.int32(0),jnp.int32(0),jnp.bool_(False),0))
        pr=jax.vmap(models.fusion.class_probabilities)(st2.belief)
        return st2.seconds,n/N,jnp.mean(jnp.argmax(pr,-1)==st2.classes),tot
    return jax.lax.map(ep,keys,batch_size=min(num,256))
keys=jax.random.split(jax.random.key(11),num); ref=None
for pol in pols:
    t=time.time(); sec,n,right,tot=map(np.asarray,run(keys,pol))
    if ref is None: ref=sec
    d=sec-ref
    print(preset,pol,"mean %.2f s (%+.2f +- %.2f) looks %.2f right %.4f total %.3f  (%.0f s)"%(sec.mean(),d.mean(),1.96*d.std()/len(d)**.5,n.mean(),right.mean(),tot.mean(),time.time()-t),flush=True)
