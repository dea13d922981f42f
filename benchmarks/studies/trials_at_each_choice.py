"""roll.py PRESET NUM K BASE...: one-step improvement of base policies by trials in the MDP."""
import sys,os
preset,num,K,*bases=sys.argv[1:]; num,K=int(num),int(K); PRICE=float(os.environ.get('PRICE','.02'))
src=open(__file__.replace('trials_at_each_choice','policies_in_mdp')).read()
sys.argv=['diag',preset,str(num)]
exec(src.split("keys=jax.random.split(jax.random.key(11)")[0])
def after(key,md,pol,st):
    """J of following pol to the end."""
    def adv(c):
        st,tot,i,done=c
        a=act(pol,jax.random.fold_in(key,2*i),st,md)
        st2,o=mdps.step(jax.random.fold_in(key,2*i+1),md,st,a)
        r=o.reward-PRICE*o.seconds*jnp.sum(st2.team.works)
        return st2,tot+r,i+1,o.terminated
    st,tot,_,_=jax.lax.while_loop(lambda c:~c[3]&(c[2]<300),adv,(st,jnp.float32(0),jnp.int32(1),jnp.bool_(False)))
    return tot
def trial(key,md,pol,st,a):
    ck,sk,fk=jax.random.split(key,3)
    pr=jax.vmap(models.fusion.class_probabilities)(st.belief)
    cl=jax.random.categorical(ck,jnp.log(pr+1e-12),axis=-1).astype(jnp.int32)
    st=dataclasses.replace(st,classes=cl,scene=md.looks.scene(sk,cl))
    st2,o=mdps.step(fk,md,st,a)
    r=o.reward-PRICE*o.seconds*jnp.sum(st2.team.works)
    return r+jnp.where(o.terminated,0.,after(jax.random.fold_in(fk,7),md,pol,st2))
def improved(pol):
    def f(key,st,md):
        ks=jax.random.split(key,K)
        js_=jax.vmap(lambda a: jax.vmap(lambda k: trial(k,md,pol,st,a))(ks).mean())(jnp.arange(N+1))
        return js_
    return f
@functools.partial(jax.jit,static_argnums=(1,))
def run_improved(keys,pol):
    md=mdp; f=improved(pol)
    def ep(key):
        sk,pk=jax.random.split(key)
        st=starts.reset(sk,md)
        def adv(c):
            st,tot,n,i,done=c
            v=f(jax.random.fold_in(pk,2*i+100000),st,md)
            a=P.best(jnp.where(st.team.action_mask,v,-jnp.inf))
            st2,o=mdps.step(jax.random.fold_in(pk,2*i+1),md,st,a)
            return st2,tot+o.reward,n+(o.poi<N),i+1,o.terminated
        st2,tot,n,_,_=jax.lax.while_loop(lambda c:~c[4]&(c[3]<300),adv,(st,jnp.float32(0),jnp.int32(0),jnp.int32(0),jnp.bool_(False)))
        pr=jax.vmap(models.fusion.class_probabilities)(st2.belief)
        return st2.seconds,n/N,jnp.mean(jnp.argmax(pr,-1)==st2.classes),tot
    return jax.vmap(ep)(keys)
keys=jax.random.split(jax.random.key(11),num)
ref=np.asarray(run(keys,"auction")[0])
for pol in bases:
    for name,r in ((pol,run),(pol+"+trials",run_improved)):
        t=time.time(); sec,n,right,tot=map(np.asarray,r(keys,pol)); d=sec-ref
        print("ROLL",preset,name,"K",K,"price",PRICE,"mean %.2f s (%.3f) (%+.2f +- %.2f) looks %.2f right %.4f total %.3f  (%.0f s)"%(sec.mean(),sec.mean()/ref.mean(),d.mean(),1.96*d.std()/len(d)**.5,n.mean(),right.mean(),tot.mean(),time.time()-t),flush=True)
