"""The seven methods, one file for each value of ``method=``, and the parts that several of them share."""
