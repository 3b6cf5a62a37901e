// Several cases beside each other: charts only.
'use strict';

startCharts();
