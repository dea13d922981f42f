import sys
src=open(__file__.replace('choosing_anew','policies_in_mdp')).read()
preset,num=sys.argv[1:3]; sys.argv=['diag',preset,num]
exec(src.split("keys=jax.random.split(jax.random.key(11)")[0])
keys=jax.random.split(jax.random.key(11),num)
m0=mdp
ref=None
for anew in (True,False):
    mdp=dataclasses.replace(m0,teams=dataclasses.replace(m0.teams,chooses_anew=anew)); run.clear_cache()
    for pol in ("auction","nearest","latent","greedy_time"):
        sec,n,right,tot=map(np.asarray,run(keys,pol))
        if ref is None: ref=sec
        d=sec-ref
        print(preset,anew,pol,"mean %.2f med %.2f p99 %.1f max %.0f s (%+.2f +- %.2f) looks %.2f right %.4f total %.3f"%(sec.mean(),np.median(sec),np.quantile(sec,.99),sec.max(),d.mean(),1.96*d.std()/len(d)**.5,n.mean(),right.mean(),tot.mean()),flush=True)
