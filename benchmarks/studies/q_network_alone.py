"""only.py PRESET SEED key=value...: trains the Q-network alone with the pretrained rest, plays the MDP."""
import sys,dataclasses,time,ast,os
src=open(__file__.replace('q_network_alone','policies_in_mdp')).read()
preset,seed,*over=sys.argv[1:]
sys.argv=['diag',preset,'512']
exec(src.split("keys=jax.random.split(jax.random.key(11)")[0])
from jaxsense.dqn import training as dqn
from jaxsense.dqn.agent import Environment
from jaxsense.models import make_agent
c0,models=load_pretrained(preset)
d=dict(o.split('=') for o in over); kind=d.pop('net',''); d={k:ast.literal_eval(v) for k,v in d.items()}
if kind:
    import variants, jaxsense.dqn.agent as AG
    AG.PoolingNetwork=variants.make(kind)
c0=dataclasses.replace(c0,dqn=dataclasses.replace(c0.dqn,**d))
import jaxsense.dqn.team as TM; TM.GAIN = bool(os.environ.get("GAIN")); TM.SOURCE[:]=[models.fusion,models.look_values]
learn=make_mdp(c0,models,js.bank(jax.random.key(77),c0,models,c0.jmvae.samples_per_class))
_s=open(mdps.__file__).read(); src0=_s[_s.index('def _look('):_s.index('def _to_go(')]
if os.environ.get('EXPECTED','1')=='1':
    import types
    src=open(mdps.__file__).read(); i=src.index("def _look("); j=src.index("def _to_go(")
    body=src[i:j].replace("    of_look = mdp.reward.of_gain(mdp.information(new) - mdp.information(old))",'''    p = mdp.fusion.class_probabilities(old)
    was = jnp.any(state.seen[place])
    each = jnp.stack([v.of_next(p, was) for v in LV])
    cost = mdp.config.look_cost if REW else 0.0
    of_look = jnp.where(jnp.arange(len(LV)) == modality, each, 0.0).sum()
    of_look = weight * (of_look + cost) - cost''')
    assert 'LV' in body
    mdps.LV=models.look_values; mdps.REW=config.mdp.reward=='nats'
    exec(compile(body,'look','exec'),mdps.__dict__)
mdps.LV=models.look_values if os.environ.get('DIFF') else ()
t=time.time()
st,info=jax.jit(lambda k: dqn.train(k,Environment(make_agent(c0),learn),c0.dqn))(jax.random.key(int(seed)))
import pickle,os; jax.block_until_ready(st.params); pickle.dump(jax.tree.map(np.asarray,st.params),open(os.environ.get('SAVE','last.pkl'),'wb')); tt=time.time()-t
mdps.LV=()
models=dataclasses.replace(models,q_networks=(st.params,),agent=make_agent(c0))
exec(compile(src0,'look0','exec'),mdps.__dict__) if os.environ.get('EXPECTED','1')=='1' else None
keys=jax.random.split(jax.random.key(11),512); ref=None
for pol in ("auction","latent"):
    sec,n,right,tot=map(np.asarray,run(keys,pol))
    if ref is None: ref=sec
    e=sec-ref
print("%s seed %s %s train %.0f s: auction %.2f latent %.2f (%.3f) %+.2f +- %.2f looks %.2f right %.4f total %.3f, loss %.4f"%(preset,seed,(kind,d),tt,ref.mean(),sec.mean(),sec.mean()/ref.mean(),e.mean(),1.96*e.std()/len(e)**.5,n.mean(),right.mean(),tot.mean(),np.asarray(info.loss)[-20:].mean()),flush=True)
