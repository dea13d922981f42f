exec(open('benchmarks/studies/policies_in_mdp.py').read().split("@functools.partial(jax.jit,static_argnums=(1,))")[0].replace("sys.argv[2]","'256'").replace("pols=sys.argv[3:]","pols=[]"))
import optax
num=1024
def ep(key):
    sk,pk=jax.random.split(key)
    st=starts.reset(sk,mdp)
    def adv(c,i):
        st,done=c
        a=act("nearest",pk,st,mdp)
        st2,o=mdps.step(jax.random.fold_in(pk,2*i+1),mdp,st,a)
        k=known(st,mdp); g=jnp.stack([gains(models,k)[0],gains(models,k)[2]],-1)
        pr=jax.vmap(models.fusion.class_probabilities)(st.belief)
        st2=jax.tree.map(lambda x,y: jnp.where(done,x,y),st,st2)
        return (st2,done|o.terminated),(st.belief.mean,st.belief.std,pr,g,~done)
    _,rows=jax.lax.scan(adv,(st,jnp.bool_(False)),jnp.arange(100))
    return jax.tree.map(lambda x:x[::4],rows)
keys=jax.random.split(jax.random.key(13),num)
mean,std,pr,g,val=jax.tree.map(np.asarray,jax.jit(lambda k: jax.lax.map(ep,k,batch_size=256))(keys))
v=val.ravel(); fl=lambda x:x.reshape(-1,*x.shape[3:]) if False else x.reshape(v.size,N,-1)[v].reshape(-1,x.shape[-1])
mean,std,pr,g=map(fl,(mean,std,pr,g)); print(mean.shape,g.shape,"known share",(g[:,0]<0).mean())
ent=-(pr*np.log(np.maximum(pr,1e-9))).sum(-1,keepdims=True)
# label entropies
L=[np.asarray(config.label_of_class(m)) for m in config.modalities]
def lent(l):
    p=np.stack([pr[:,l==j].sum(1) for j in range(l.max()+1)],1); return -(p*np.log(np.maximum(p,1e-9))).sum(-1,keepdims=True)
le=np.concatenate([lent(l) for l in L],1)
sets={"mean+std":np.c_[mean,std],"mean+std+H":np.c_[mean,std,ent],"mean+std+logstd":np.c_[mean,std,np.log(std)],"m+s+Hlabels":np.c_[mean,std,le],"Hlabels only":le}
def mlp(sizes,key):
    return [(jax.random.normal(k,(a,b))*np.sqrt(2/a),jnp.zeros(b)) for k,a,b in zip(jax.random.split(key,len(sizes)),sizes[:-1],sizes[1:])]
def ap(p,x):
    for w,b in p[:-1]: x=jax.nn.relu(x@w+b)
    w,b=p[-1]; return x@w+b
for name,X in sets.items():
    X=jnp.asarray(X); Y=jnp.asarray(g); n=len(X); tr=n*9//10
    p=mlp([X.shape[1],64,64,2],jax.random.key(0)); S=6000
    opt=optax.adam(optax.cosine_decay_schedule(1e-3,S,.01)); s=opt.init(p)
    @jax.jit
    def go(p,s,key):
        def st(c,k):
            p,s=c; i=jax.random.randint(k,(1024,),0,tr)
            l,gr=jax.value_and_grad(lambda p: jnp.mean((ap(p,X[i])-Y[i])**2))(p)
            u,s=opt.update(gr,s,p); return (optax.apply_updates(p,u),s),l
        return jax.lax.scan(st,(p,s),jax.random.split(key,S))
    (p,s),l=go(p,s,jax.random.key(1)); e=np.asarray(ap(p,X[tr:])-Y[tr:]); y=np.asarray(Y[tr:])
    low=y<-.018; f=np.asarray(ap(p,X[tr:]))
    print(name,"rmse %.4f, at useless %.4f, share useless >0 %.4f"%(np.sqrt((e**2).mean()),np.sqrt((e[low]**2).mean()),(f[low]>0).mean()),flush=True)
