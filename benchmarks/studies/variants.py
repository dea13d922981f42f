import jax,jax.numpy as jnp
from flax import linen as nn
from jaxsense.core.networks import Dense
from jaxsense.dqn.pooling import _heard,_NOTHING,_MESSAGES
class _Base(nn.Module):
    hidden: tuple
    features: int
    kind: str = "split"
    @nn.compact
    def __call__(self,x):
        batch=x.shape[1:]
        x=x.reshape(self.features,x.shape[0]//self.features,*batch)
        present,place,known=x[-3][None],x[-2:],x[:-2]
        def dense(size,name,x,last=False):
            kind=nn.initializers.lecun_normal() if last else nn.initializers.he_normal()
            return Dense(size,kind,name=name)(x.reshape(x.shape[0],-1)).reshape(size,*x.shape[1:])
        each=known
        for i,size in enumerate(self.hidden): each=nn.relu(dense(size,f"PoI_{i}",each))
        each=each*present
        message=nn.relu(dense(_MESSAGES,"Message",each,last=True))*present
        number=jnp.maximum(jnp.sum(present,axis=1),1.)
        pool=jnp.concatenate([jnp.sum(each,axis=1)/number,jnp.max(each,axis=1)])
        own=jnp.concatenate([known,each,_heard(message,present,place)])
        context=dense(self.hidden[-1],"Context",pool)
        of_poi=nn.relu(dense(self.hidden[-1],"Own",own)+context[:,None])
        v=dense(1,"Value",of_poi,last=True)
        if self.kind=="split": value=(dense(1,"Look",each,last=True)+nn.relu(v))[0]
        elif self.kind=="soft": value=(dense(1,"Look",each,last=True)+nn.softplus(4*v-2)/4)[0]
        elif self.kind=="own":
            e=known
            for i,size in enumerate(self.hidden): e=nn.relu(dense(size,f"Look_{i}",e))
            value=(dense(1,"Look",e,last=True)+nn.relu(v))[0]
        else: value=v[0]
        return jnp.concatenate([jnp.where(present[0]>0,value,_NOTHING),jnp.zeros((1,*batch))])
def make(kind):
    class V(_Base): pass
    V.__dataclass_fields__ if False else None
    return lambda hidden,features: _Base(hidden,features,kind)
