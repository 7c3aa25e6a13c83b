from sim import *
os.chdir('/tmp/review2')
import mwdcal, numpy as np
from datetime import date
from mwdcal.survey.place.references import load_reference, reference_at
place = reference_at(60.0, 3.5, 40.0, date(2026, 7, 1), crs="EPSG:23031", measured={"field": 51_300.0})
print(place.offset_deg("grid")); print(load_reference("ref.json")[1][:8])
from mwdcal.survey.tool_model import sensor_terms, write_tool_model
cal=mwdcal.load('cal.json')
print(sensor_terms(cal)); write_tool_model("tool7.json", cal, "tool 7"); print(os.path.getsize('tool7.json'))
# conventions
rng=np.random.default_rng(5); 
import sim
sim.ORD={'acc':['+z','+y','-x'],'mag':['+z','+y','-x']}
t=Tool(rng); t.sa=1000.; t.sm=1.; lab(t,rng,'sl.csv'); r=cli('calibrate','sl.csv','--tool','convention-schlumberger','-o','sl.json'); print(r.rc,r.err[:300])
I=np.array([20,60.]);A=np.array([30,200.]);F=np.array([10.,300.]); write('sw.csv',wellcols(t,rng,I,A,F,[0,30.])); r=cli('survey','sl.json','sw.csv','-o','so.csv'); o=read('so.csv'); print(o['inclination_deg'],o['azimuth_magnetic_deg'],o['toolface_deg'])
# WITSML with tie-in station without raw data
x=open('fin.xml').read(); import re
i=x.index('<trajectoryStation'); j=x.index('</trajectoryStation>')+len('</trajectoryStation>')
st=x[i:j]; bare=re.sub(r'<rawData>.*?</rawData>','',st,flags=re.S).replace('S0','TIE').replace('>500','>470')
open('tie.xml','w').write(x[:i]+bare+x[i:]); r=cli('survey','cal.json','tie.xml','-o','to.xml'); print('tie-in station',r.rc,r.err[:300])
